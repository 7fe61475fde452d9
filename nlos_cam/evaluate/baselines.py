"""What a reconstructor has to beat: answers that need no network, among them the nearest training object."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from nlos_calibration.arrays import Float16, Float32
from nlos_models import SMALLEST_SPREAD, MapSet, channel_statistics, split_and_stack
from torch import Tensor

from nlos_cam.dataset import (
    TRAINING_SEED,
    Dataset,
    DatasetPlan,
    Objects,
    build_dataset,
    open_dataset,
    procedural_images,
)

NEIGHBOURS = 2000
"""Training objects that the nearest one is searched among, unless a training set is given."""
TOLD_BY = 200
"""Of them, those that tell whether objects are still made as they were: every category is among them."""

OnProgress = Callable[[int, int], None]


class TrainingMaps(Protocol):
    """Training objects as a rig sees them; a dataset is such."""

    def __len__(self) -> int: ...

    def chunks(self) -> Iterator[MapSet]:
        """All of them, a part at a time."""
        ...


def without_maps(count: int, mean: Float32) -> dict[str, Float32]:
    """Images (count, 64, 64) that look at no map: background alone, and the mean of training's images (64, 64)."""
    shape = (count, *mean.shape)
    return {"all_background": np.zeros(shape, np.float32), "mean_object": np.broadcast_to(mean, shape)}


def mean_image(images: Float16) -> Float32:
    """The mean (64, 64) of images (n, 64, 64)."""
    return images.mean(0, dtype=np.float64).astype(np.float32)


def with_nearest(maps: MapSet, training: TrainingMaps, on_progress: OnProgress) -> dict[str, Float32]:
    """The same, and the image of the training object nearest to each of some maps; a part at a time is in memory.

    Nearest by least squares between raw maps, of all cells of depth and intensity, each channel (left, right) less its
    mean and over its spread in the first NEIGHBOURS training objects. A cell without a return is an average one.
    """
    search, total, done = _Search(maps, *_statistics(training)), np.zeros(maps.image.shape[1:]), 0
    for chunk in training.chunks():
        search.look_at(chunk)
        total += chunk.image.sum(0, dtype=np.float64)
        done += len(chunk.image)
        on_progress(done, len(training))
    mean = (total / done).astype(np.float32)
    return {**without_maps(len(maps.image), mean), "nearest_neighbour": search.image}


class _Search:
    """The nearest to each of some maps, among all that were looked at."""

    def __init__(self, maps: MapSet, mean: Tensor, spread: Tensor) -> None:
        self._mean, self._scale = mean[:, None, None], spread.clamp(min=SMALLEST_SPREAD)[:, None, None]
        self._sought = self._normalised(maps)
        self._distance = torch.full((len(maps.image),), torch.inf)
        self.image = np.zeros(maps.image.shape, np.float32)
        """(n, 64, 64)."""

    def look_at(self, training: MapSet) -> None:
        """Take what is nearer than all before."""
        distance, which = torch.cdist(self._sought, self._normalised(training)).min(1)
        nearer = distance < self._distance
        self.image[nearer.numpy()] = training.image[which[nearer].numpy()]
        self._distance = torch.minimum(distance, self._distance)

    def _normalised(self, maps: MapSet) -> Tensor:
        return torch.nan_to_num((_stacked(maps) - self._mean) / self._scale).flatten(1)


def _stacked(maps: MapSet) -> Tensor:
    return split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity))


def _statistics(training: TrainingMaps) -> tuple[Tensor, Tensor]:
    parts = list[Tensor]()
    for chunk in training.chunks():
        parts.append(_stacked(chunk))
        if sum(map(len, parts)) >= NEIGHBOURS:
            break
    return channel_statistics(torch.cat(parts))


def training_maps(plan: DatasetPlan, cache: Path, workers: int, on_progress: OnProgress) -> Dataset:
    """The first NEIGHBOURS training objects as this plan's rig and sensor see them, built once into a cache folder.

    A build that was cut short goes on where it was. The folder is named by a checksum of rig, sensor and objects.
    """
    plan = replace(plan, first_seed=TRAINING_SEED, objects=Objects())
    folder = cache / "neighbours" / f"{_checksum(plan)}-{NEIGHBOURS}"
    build_dataset(plan, NEIGHBOURS, folder, workers=workers, on_progress=on_progress)
    return open_dataset(folder)


def _checksum(plan: DatasetPlan) -> str:
    """Of the plan, and of what its objects look like: another shape of cup is another training set."""
    digest = hashlib.sha256(plan.provenance.encode())
    digest.update(procedural_images(plan.first_seed, TOLD_BY, plan.box).tobytes())
    return digest.hexdigest()[:16]
