"""Labelled recordings as a dataset: the shards that `dataset build` makes, so that whatever reads those reads these."""

from pathlib import Path

import numpy as np

from nlos_cam.dataset import SHARD, DatasetPlan
from nlos_cam.dataset_plan import scene_row
from nlos_cam.dataset_samples import Samples
from nlos_cam.dataset_shards import SHARDS, shard_path, store
from nlos_cam.errors import DiskFullError
from nlos_cam.folders import renamed_when_whole
from nlos_cam.labelled import Labelled

RECORDED = "recorded"
"""The accuracy of what was not rendered."""


def plan_of(labelled: Labelled) -> DatasetPlan:
    """The plan that stands in the shards. Its sensor says nothing: that of a real device is not known."""
    return DatasetPlan(labelled.rig, first_seed=0, accuracy=RECORDED)


def write_shards(labelled: Labelled, folder: Path, command: str = "") -> None:
    """Write the samples as a dataset, in place of the shards that are there; a seed is a sample's number.

    Those go when all of the new ones are on the disk. Raises DiskFullError where these do not fit, OutputExistsError
    where `folder` is a file.
    """
    provenance, samples = plan_of(labelled).provenance, _samples(labelled)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with renamed_when_whole(folder) as whole:
        for start in range(0, len(labelled.label), SHARD):
            part = {name: values[start : start + SHARD] for name, values in samples.items()}
            try:
                store(shard_path(whole, start), part, provenance, command)
            except DiskFullError as error:
                raise DiskFullError(f"no room for the dataset {folder}: what was there is kept; make room") from error
        for shard in folder.glob(SHARDS):  # so that no stop leaves shards of both
            shard.unlink()


def _samples(labelled: Labelled) -> Samples:
    maps, plan = labelled.maps, plan_of(labelled)
    *geometry, _ = scene_row(plan.rig, plan.sensor)
    return {
        "depth_m": maps.depth_m,
        "intensity": maps.intensity,
        "image": maps.image,
        "object_depth_m": labelled.object_depth_m,
        "seed": np.arange(len(labelled.label)),
        "scene": np.tile([*geometry, np.nan], (len(labelled.label), 1)),
        "category": np.array(labelled.label, object),
    }
