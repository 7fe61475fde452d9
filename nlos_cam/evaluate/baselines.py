"""Trivial baselines: background only, mean object, nearest training object."""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from nlos_calibration import Rig
from nlos_calibration.arrays import Float16, Float32
from nlos_models import SMALLEST_SPREAD, channel_statistics, split_and_stack
from nlos_models.training import MapSet
from torch import Tensor

from nlos_cam import dataset as data
from nlos_cam.camera import OnProgress
from nlos_cam.errors import FolderBusyError, NlosCamError, OutputExistsError, SceneError
from nlos_cam.reconstruct import NUMBERS_COLUMN, WALL_GRID, align_samples

NEIGHBOURS = 2000
"""Training objects searched for the nearest neighbour, unless a training set is given."""
FINGERPRINT_OBJECTS = 200
"""Objects whose images go into the cache key, so that a changed generator gets a new cache; all
categories occur.
"""


def trivial_answers(count: int, mean: Float32) -> dict[str, Float32]:
    """Return answers (count, 64, 64) that ignore the maps: background only, and the mean training
    image (64, 64).
    """
    shape = (count, *mean.shape)
    return {
        "all_background": np.zeros(shape, np.float32),
        "mean_object": np.broadcast_to(mean, shape),
    }


def mean_image(images: Float16) -> Float32:
    """Return the mean (64, 64) of images (n, 64, 64)."""
    return images.mean(0, dtype=np.float64).astype(np.float32)


def answers_with_nearest(
    maps: MapSet, training: data.Dataset, on_progress: OnProgress, *, on_grid: bool = False
) -> dict[str, Float32]:
    """Return the trivial answers and the image of the nearest training object; one part at a time
    is in memory.

    Nearest in the sum of squares over all cells of depth and intensity, each channel (left, right)
    minus its mean and divided by its spread over the first NEIGHBOURS training objects. A cell
    without a return counts as average. With `on_grid` training maps are compared as `on_wall_grid`,
    as `maps` have to be.
    """
    search = _Search(maps, *_statistics(training, on_grid=on_grid))
    total = np.zeros(maps.image.shape[1:])
    done = 0
    for chunk in _parts(training, on_grid=on_grid):
        search.update(chunk)
        total += chunk.image.sum(0, dtype=np.float64)
        done += len(chunk.image)
        on_progress(done, len(training))
    mean = (total / done).astype(np.float32)
    return {**trivial_answers(len(maps.image), mean), "nearest_neighbour": search.image}


class _Search:
    """Running search for the nearest training object of each map; single-threaded."""

    def __init__(self, maps: MapSet, mean: Tensor, spread: Tensor) -> None:
        self._mean = mean[:, None, None]
        self._scale = spread.clamp(min=SMALLEST_SPREAD)[:, None, None]
        self._maps = self._normalised(maps)
        self._distance = torch.full((len(maps.image),), torch.inf)
        self.image = np.zeros(maps.image.shape, np.float32)
        """(n, 64, 64)."""

    def update(self, training: MapSet) -> None:
        """Replace the answers that these objects are nearer to."""
        distance, which = torch.cdist(self._maps, self._normalised(training)).min(1)
        nearer = distance < self._distance
        self.image[nearer.numpy()] = training.image[which[nearer].numpy()]
        self._distance = torch.minimum(distance, self._distance)

    def _normalised(self, maps: MapSet) -> Tensor:
        return torch.nan_to_num((_stacked(maps) - self._mean) / self._scale).flatten(1)


def _stacked(maps: MapSet) -> Tensor:
    return split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity))


def _statistics(training: data.Dataset, *, on_grid: bool) -> tuple[Tensor, Tensor]:
    parts = list[Tensor]()
    for chunk in _parts(training, on_grid=on_grid):
        parts.append(_stacked(chunk))
        if sum(map(len, parts)) >= NEIGHBOURS:
            break
    return channel_statistics(torch.cat(parts))


def _parts(training: data.Dataset, *, on_grid: bool) -> Iterator[MapSet]:
    """Yield a dataset's maps in parts, as they are or `on_wall_grid`."""
    if not on_grid:
        yield from training.chunks()
        return
    benches = training.benches()
    for chunk in training.chunks():
        yield on_wall_grid(chunk, islice(benches, len(chunk.image)))


def on_wall_grid(maps: MapSet, benches: Iterable[Rig]) -> MapSet:
    """Return maps as the wall grid sees them, without the rigs' numbers, which are no light."""
    aligned = align_samples(maps, benches, WALL_GRID)[0]
    aligned.depth_m[:, :, NUMBERS_COLUMN] = np.nan
    aligned.intensity[:, :, NUMBERS_COLUMN] = 0.0
    return aligned


def training_maps(
    plan: data.DatasetPlan,
    cache: Path,
    workers: int,
    on_progress: OnProgress,
    first_seed: int = data.TRAINING_SEED,
) -> data.Dataset:
    """Build NEIGHBOURS training objects from a seed on, on the plan's rig and sensor, into the
    cache, once.

    An interrupted build resumes. The folder's name is a checksum of rig, sensor and objects. For
    recordings the objects are rendered on the bench's measured rig, with the simulated sensor.
    Raises SceneError while another process builds them, or where the cache cannot be written to.
    """
    accuracy = "standard" if plan.accuracy == data.RECORDED else plan.accuracy
    plan = replace(plan, first_seed=first_seed, accuracy=accuracy, objects=data.Objects())
    folder = cache / "neighbours" / f"{_checksum(plan)}-{NEIGHBOURS}"
    try:
        data.build_dataset(plan, NEIGHBOURS, folder, workers=workers, on_progress=on_progress)
    except (FolderBusyError, OutputExistsError) as error:
        if found := _whole(folder):  # another process reads it, or nobody may write to it
            return found
        raise SceneError(
            f"the training objects for the nearest neighbour cannot be rendered into {folder}: wait"
            " for another evaluation, set NLOS_CAM_CACHE to another folder, or give --no-nearest"
        ) from error
    return data.open_dataset(folder)


def _whole(folder: Path) -> data.Dataset | None:
    """Return the dataset in a folder if it has all NEIGHBOURS; else None."""
    try:
        found = data.open_dataset(folder)
    except NlosCamError:
        return None
    return found if len(found) == NEIGHBOURS else None


def _checksum(plan: data.DatasetPlan) -> str:
    """Return a checksum of the plan and of its first objects: another generator makes another
    training set.
    """
    digest = hashlib.sha256(plan.provenance.encode())
    digest.update(data.procedural_images(plan.first_seed, FINGERPRINT_OBJECTS, plan.box).tobytes())
    return digest.hexdigest()[:16]
