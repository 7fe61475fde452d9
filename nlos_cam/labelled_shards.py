"""Labelled recordings as a dataset: the shards that `dataset build` makes, so that whatever reads those reads these."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nlos_cam.dataset import SHARD, DatasetPlan
from nlos_cam.labelled import Labelled

RECORDED = "recorded"
"""The accuracy of what was not rendered."""


def plan_of(labelled: Labelled) -> DatasetPlan:
    """The plan that stands in the shards. Its sensor says nothing: that of a real device is not known."""
    return DatasetPlan(labelled.rig, first_seed=0, accuracy=RECORDED)


def write_shards(labelled: Labelled, folder: Path) -> None:
    """Write the samples as a dataset, in place of the shards that are there; a seed is a sample's number."""
    folder.mkdir(parents=True, exist_ok=True)
    for shard in folder.glob("shard-*.h5"):
        shard.unlink()
    provenance, samples = plan_of(labelled).provenance, _samples(labelled)
    for start in range(0, len(labelled.label), SHARD):
        path = folder / f"shard-{start:09d}.h5"
        part = path.with_suffix(".part")
        with h5py.File(part, "w") as file:
            file.attrs["plan"] = provenance
            for name, values in samples.items():
                kind = h5py.string_dtype() if values.dtype == object else values.dtype
                file.create_dataset(name, data=values[start : start + SHARD], dtype=kind, compression="gzip")
        part.replace(path)


def _samples(labelled: Labelled) -> dict[str, NDArray[Any]]:
    maps = labelled.maps
    return {
        "depth_m": maps.depth_m,
        "intensity": maps.intensity,
        "image": maps.image,
        "object_depth_m": labelled.object_depth_m,
        "seed": np.arange(len(labelled.label)),
        "category": np.array(labelled.label, object),
    }
