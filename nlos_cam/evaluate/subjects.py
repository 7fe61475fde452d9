"""The objects that weights are judged on, and the maps that a lidar with noise makes of them on any rig.

What weights are judged on: the test objects or a dataset, as maps that the weights eat, on the rig of either.
"""

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from nlos_calibration import ObjectBox, Rig, rig_named
from nlos_calibration.arrays import Float32
from nlos_calibration.errors import RecordFileError
from nlos_models import CheckpointRecord, MapSet, Reconstructor, less_bare_wall

from nlos_cam.camera import World
from nlos_cam.dataset import (
    TEST_SEED,
    TRAINING_SEED,
    BareMaps,
    Dataset,
    DatasetPlan,
    measured_bare_wall,
    open_dataset,
    procedural_images,
    render_bare_wall,
)
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import baselines as trivial
from nlos_cam.files import cache_folder
from nlos_cam.frames import LidarMaps, MapMean, maps_from_frame
from nlos_cam.objects import benchmark_objects, image_from_depth, object_depth
from nlos_cam.render import MultiBounce, Scene, SceneFile, SensorModel, render

OnProgress = Callable[[int, int], None]
Tracked = Callable[[str], AbstractContextManager[OnProgress]]
"""Opens a progress bar with a description; its function takes what is done and the total."""


@contextmanager
def untracked(description: str) -> Generator[OnProgress]:
    """Show no progress."""
    del description
    yield lambda _done, _total: None


QUIET = SensorModel(range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0)
"""A sensor without noise or dead pixels; saturation and quantisation stay."""


class Subject(Protocol):
    """An object to judge on; those of the test set are such."""

    @property
    def name(self) -> str:
        """What tables and pictures call it."""
        ...

    @property
    def category(self) -> str:
        """Its kind."""
        ...

    @property
    def depth_m(self) -> Float32:
        """(64, 64); NaN for background."""
        ...


@dataclass(frozen=True)
class SeededObject:
    """A random object."""

    name: str
    category: str
    depth_m: Float32


def seeded_objects(first_seed: int, count: int, box: ObjectBox) -> list[SeededObject]:
    """Random objects by their seeds."""
    made = [object_depth(seed, box) for seed in range(first_seed, first_seed + count)]
    return [SeededObject(f"{category} {first_seed + k}", category, depth) for k, (category, depth) in enumerate(made)]


def truth_of(subjects: Sequence[Subject], box: ObjectBox) -> Float32:
    """The images (n, 64, 64) that a perfect reconstruction would be."""
    return np.stack([image_from_depth(subject.depth_m, box) for subject in subjects])


def echoes_of(subjects: Sequence[Subject], rig: Rig, on_progress: OnProgress) -> list[MultiBounce]:
    """What comes back from each object on a rig, before any sensor."""
    echoes: list[MultiBounce] = []
    for subject in subjects:
        echoes.append(render(Scene(rig, subject.depth_m)).multi)
        on_progress(len(echoes), len(subjects))
    return echoes


def sense(echoes: list[MultiBounce], rig: Rig, sensor: SensorModel | None = None, frames: int = 1) -> list[LidarMaps]:
    """The maps of each echo as `live` makes them: the sensor's chain, cells, and the mean of so many frames.

    The frames are the simulated camera's, bit for bit, without the pace of a device: the same call gives the same maps.
    """
    scene = SceneFile(name="test objects", rig=rig, sensor=sensor or SensorModel())
    world = World(scene, echoes, [None])
    return [_averaged(world, range(k, k + frames * len(echoes), len(echoes))) for k in range(len(echoes))]


def _averaged(world: World, numbers: Sequence[int]) -> LidarMaps:
    mean = MapMean(len(numbers))
    frames = (world.images(number).frame(world.rig.pinhole) for number in numbers)
    return [mean.add(maps_from_frame(frame)) for frame in frames][-1]


def as_map_set(maps: Sequence[LidarMaps], truth: Float32) -> MapSet:
    """Maps beside their truths (n, 64, 64)."""
    return MapSet(np.stack([m.depth_m for m in maps]), np.stack([m.intensity for m in maps]), truth)


def reconstruct_all(reconstructor: Reconstructor, maps: MapSet) -> Float32:
    """Images (n, 64, 64), one object at a time, as live does it."""
    pairs = zip(maps.depth_m, maps.intensity, strict=True)
    return np.concatenate([reconstructor(depth[None], intensity[None]) for depth, intensity in pairs])


@dataclass(frozen=True)
class Judged:
    """Objects to judge on."""

    what: str
    """In words, for the report."""
    names: list[str]
    categories: list[str]
    maps: MapSet
    """Raw ones, whatever the weights eat: the baselines look at these."""
    plan: DatasetPlan


def rig_of(record: CheckpointRecord) -> Rig:
    """The rig that weights were trained for. Raises SceneError where it is neither packaged nor a file that is here."""
    try:
        return rig_named(record.rig_name)
    except RecordFileError as error:
        raise SceneError(
            f"these weights are for the rig {record.rig_name!r}, which is not at hand ({error}): name one with --rig"
        ) from error


def fresh_objects(rig: Rig, count: int | None = None, tracked: Tracked = untracked) -> Judged:
    """The 54, or so many random objects, through the noise of the simulated camera on a rig."""
    plan = DatasetPlan(rig, TEST_SEED)
    subjects = seeded_objects(plan.first_seed, count, plan.box) if count else benchmark_objects(plan.box)
    with tracked("rendering test objects") as on_progress:
        echoes = echoes_of(subjects, rig, on_progress)
    maps = as_map_set(sense(echoes, rig), truth_of(subjects, plan.box))
    kind = "random objects" if count else "fixed test objects"
    what = f"{len(subjects)} {kind} that training never draws, through the sensor's noise"
    return Judged(what, [one.name for one in subjects], [one.category for one in subjects], maps, plan)


def stored_objects(folder: Path) -> Judged:
    """Those of a dataset."""
    opened = open_dataset(folder)
    categories = [str(category) for category in opened.column("category")]
    names = [f"{category} {seed}" for category, seed in zip(categories, opened.column("seed"), strict=True)]
    return Judged(f"Maps of {folder}", names, categories, opened.arrays(), opened.plan)


def bare_wall_for(record: CheckpointRecord, plan: DatasetPlan, wall: Path | None = None) -> BareMaps | None:
    """The bare wall that weights want their maps less of, as `train` took it; None where they eat raw maps.

    Raises SceneError for a measured wall that would be of no use.
    """
    if record.input == "raw maps":
        if wall:
            raise SceneError(f"these weights eat raw maps, and {wall} is for difference maps: leave out --wall")
        return None
    return measured_bare_wall(wall) if wall else render_bare_wall(plan)


def as_eaten(maps: MapSet, bare: BareMaps | None) -> MapSet:
    """Raw maps as weights eat them."""
    return less_bare_wall(maps, *bare) if bare else maps


def baseline_images(
    judged: Judged, training: Path | None, *, nearest: bool, tracked: Tracked = untracked
) -> tuple[dict[str, Float32], Dataset | None]:
    """The baselines' images, and the training objects that the nearest was looked for among, if it is wanted."""
    if not nearest:
        images = procedural_images(TRAINING_SEED, trivial.NEIGHBOURS, judged.plan.box)
        return trivial.without_maps(len(judged.names), trivial.mean_image(images)), None
    if training:
        opened = open_dataset(training)
    else:
        with tracked("rendering training objects for the nearest neighbour, once") as on_progress:
            opened = trivial.training_maps(judged.plan, cache_folder(), os.cpu_count() or 1, on_progress)
    with tracked("looking for the nearest") as on_progress:
        return trivial.with_nearest(judged.maps, opened, on_progress), opened


def notes_on(record: CheckpointRecord, judged: Judged, training: Dataset | None) -> list[str]:
    """What a reader has to know to read the figures."""
    rig, told = judged.plan.rig, list[str]()
    if record.rig_checksum != rig.checksum:
        told.append(
            f"the weights were trained for the rig {record.rig_name}, and these maps are of another, {rig.name}"
        )
    if training and training.plan.rig.checksum != rig.checksum:
        told.append(
            f"the nearest neighbour is of {training.folder}, whose maps are of another rig than those judged on"
        )
    if unseen := sorted(set(left_out_of(record)) & set(judged.categories)):
        told.append(f"the weights' VAE was never shown {', '.join(unseen)}")
    return told


def left_out_of(record: CheckpointRecord) -> list[str]:
    """The categories of objects that weights' VAE was not shown."""
    return record.vae_recipe.left_out if record.vae_recipe else []
