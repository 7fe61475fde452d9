"""What a reconstructor has to beat: answers that need no network, among them the nearest training object."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from nlos_models.data import Half, MapSet
from nlos_models.preprocess import channel_statistics, split_and_stack
from numpy.typing import NDArray

import nlos_cam.objects
from nlos_cam import dataset
from nlos_cam.frames import Float32

NEIGHBOURS = 2000
"""Training objects that the nearest one is searched among, unless a training set is given."""

OnProgress = Callable[[int, int], None]


def baselines(maps: MapSet, training_images: Half | Float32, training: MapSet | None) -> dict[str, Float32]:
    """Images (n, 64, 64) that need no network; the nearest neighbour only where training maps are at hand."""
    shape = (len(maps.image), *training_images.shape[1:])
    mean = training_images.astype(np.float32).mean(0)
    guesses = {
        "all_background": np.zeros(shape, np.float32),
        "mean_object": np.broadcast_to(mean, shape).astype(np.float32),
    }
    if training is not None:
        guesses["nearest_neighbour"] = training.image[_nearest(maps, training)].astype(np.float32)
    return guesses


def _nearest(maps: MapSet, training: MapSet) -> NDArray[np.int64]:
    """The training sample (n,) whose normalised maps are nearest in the sense of least squares."""
    stacks = [split_and_stack(torch.from_numpy(m.depth_m), torch.from_numpy(m.intensity)) for m in (maps, training)]
    mean, spread = channel_statistics(stacks[1])
    flat = [torch.nan_to_num((s - mean[:, None, None]) / spread[:, None, None]).flatten(1) for s in stacks]
    return torch.cdist(flat[0], flat[1]).argmin(1).numpy()


def training_maps(plan: dataset.DatasetPlan, cache: Path, workers: int, on_progress: OnProgress) -> MapSet:
    """The first NEIGHBOURS training objects as this plan's rig and sensor see them, built once into a cache folder.

    A build that was cut short goes on where it was. The folder is named by a checksum of rig, sensor and objects.
    """
    plan = replace(plan, first_seed=dataset.TRAINING_SEED, objects=dataset.Objects())
    folder = cache / "neighbours" / f"{_checksum(plan)}-{NEIGHBOURS}"
    dataset.build(plan, NEIGHBOURS, folder, workers=workers, on_progress=on_progress)
    return dataset.read(folder)[0]


def _checksum(plan: dataset.DatasetPlan) -> str:
    """Of the plan, and of the code that makes objects: another shape of cup is another training set."""
    digest = hashlib.sha256(plan.provenance.encode())
    for source in sorted(Path(nlos_cam.objects.__path__[0]).glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
