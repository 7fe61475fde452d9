"""Request for an adaptation, with its folders, its objects on the bench and its start weights."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import nlos_models as models
from nlos_calibration import Rig
from nlos_models import training

from nlos_cam import dataset as data
from nlos_cam.adapt.plan import Locked
from nlos_cam.adapt.recordings import Recordings
from nlos_cam.errors import SceneError
from nlos_cam.files import checksums_of, damaged_files
from nlos_cam.reconstruct import weights_for
from nlos_cam.render import SensorModel

OBJECTS = "objects"
HELD_OUT = "held-out"
JUDGED = "judged"
QUALITY = "scored"
EARLIER_QUALITY = "quality"
"""Folder of the quality model's objects in nlos-cam 0.2.0, where they were on the rig itself."""
OUTLIERS = "outliers"
NETWORK = "network"
WEIGHTS = "weights"
SHARE_GENERIC = 0.5


@dataclass(frozen=True)
class Adaptation:
    """Request for an adaptation: the bench, the weights to start from, and the processes to use."""

    rig: Rig
    spread: data.RigSpread
    """How far the bench may be off its rig."""
    folder: Path
    start: Path | None = None
    """Start weights; None for the shipped ones that serve the rig best."""
    sensor: SensorModel = field(default_factory=SensorModel)
    seed: int = 0
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes that render."""
    farm: data.Farm | None = None
    """Cluster that renders in place of `workers` processes here."""
    accelerator: Literal["auto", "cpu", "cuda"] = "auto"
    locked: Locked | None = None
    """Locked differences in place of maps; their weights are for a study, not for `live`."""
    recordings: Recordings | None = None
    """Recordings of known objects on the bench, if there are any."""
    begin_again: bool = False
    """True to empty a folder that holds an adaptation to another rig; else that is an error."""
    began_from: Path | None = None
    """Shipped weights that the work in the folder began from. They stay the start weights, also
    where a later version of the program would choose others."""

    @property
    def start_folder(self) -> Path:
        """Folder of the start weights."""
        if self.start:
            return models.weights_folder(self.start)
        if self.locked:  # differences in the bench's own cells, which the wall grid has not
            return weights_for(self.rig, models.RIG_WEIGHTS)
        return self.began_from or weights_for(self.rig)

    @property
    def renderers(self) -> int:
        """Number of processes that render, as far as a farm knows."""
        return getattr(self.farm, "workers", 1) if self.farm else self.workers


def data_plan(
    job: Adaptation, first_seed: int, *, expected: bool, off_record: bool
) -> data.DatasetPlan:
    """Return the plan of objects on the bench as it may be where `off_record`, else on the rig
    itself.
    """
    if job.locked:
        return data.DatasetPlan(
            job.rig,
            first_seed,
            job.sensor,
            accuracy=data.LOCKED,
            objects=data.Objects(share_generic=SHARE_GENERIC),
            radiometry=job.locked.radiometry,
            material=job.locked.material,
        )
    return data.DatasetPlan(
        job.rig,
        first_seed,
        job.sensor,
        accuracy="draft",
        objects=data.Objects(share_generic=SHARE_GENERIC),
        spread=job.spread if off_record else data.RigSpread(),
        expected=expected,
        objects_per_rig=data.OBJECTS_PER_RIG if off_record else 1,
        off_record=off_record,
    )


def start_network(
    recipe: training.DirectRecipe, folder: Path
) -> tuple[models.DirectNetwork, list[training.Recipe]]:
    """Return the direct network in a folder, and the runs that made it. Raises TrainingError for
    weights that the recipe does not go on from.
    """
    network, runs = training.direct_start(recipe, folder)
    if network is None:
        raise SceneError("the recipe of an adaptation starts from scratch")
    return network, runs


def render_set(
    job: Adaptation,
    name: str,
    first_seed: int,
    count: int,
    tracked: data.Tracked,
    *,
    off_record: bool = False,
) -> Path:
    """Return a folder of `count` objects with the sensor's noise, on the rig itself or on the bench
    as it may be.
    """
    plan = data_plan(job, first_seed, expected=False, off_record=off_record)
    title = f"rendering {count} objects ({name})"
    return render_objects(job, plan, name, count, title, tracked)


def render_training_objects(job: Adaptation, count: int, tracked: data.Tracked) -> None:
    """Render objects for the bench as it may be, up to `count` with those that are there."""
    plan = data_plan(job, job.seed, expected=True, off_record=True)
    title = f"rendering objects for this bench, {count} in all"
    render_objects(job, plan, OBJECTS, count, title, tracked)


def render_objects(
    job: Adaptation,
    plan: data.DatasetPlan,
    name: str,
    count: int,
    title: str,
    tracked: data.Tracked,
) -> Path:
    """Render the first `count` objects of a plan into a folder of the adaptation, and return it."""
    folder = job.folder / name
    with tracked(title) as on_progress:
        data.build_dataset(
            plan,
            count,
            folder,
            workers=job.workers,
            on_progress=on_progress,
            farm=job.farm,
        )
    return folder


def is_whole(folder: Path, last: str) -> bool:
    """Return whether a folder of weights has all its files, of which `last` is written last, with
    their checksums.
    """
    return last in checksums_of(folder) and not damaged_files(folder)
