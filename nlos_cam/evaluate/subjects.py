"""Held-out objects as maps with sensor noise: the fixed test objects, random ones, or those of a
dataset.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np
from nlos_calibration import ObjectBox, Rig, rig_difference, rig_named
from nlos_calibration.arrays import Float32
from nlos_calibration.errors import RecordFileError
from nlos_models import Answer, CheckpointRecord, Reconstructor, UncertaintyModel, ask
from nlos_models.training import MapSet, subtract_bare_wall

from nlos_cam import dataset as data
from nlos_cam import objects as shapes
from nlos_cam.camera import OnProgress, World
from nlos_cam.dataset import Tracked, as_map_set, untracked
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import baselines as trivial
from nlos_cam.evaluate.metrics import Predictions
from nlos_cam.files import cache_folder
from nlos_cam.frames import LidarMaps, MapMean, maps_from_frame
from nlos_cam.reconstruct import (
    WALL_GRID,
    FrameConditions,
    Reconstruction,
    Verdict,
    VerdictFilter,
    align_all,
    can_align,
    estimate_uncertainty,
    grid_of,
    own_rig,
    rig_to_align_with,
    verdict_limits,
)
from nlos_cam.render import MultiBounce, Scene, SceneFile, SensorModel, render

TestSet = Literal["kinds", "unseen"]
TEST_SETS: dict[TestSet, str] = {
    "kinds": "fixed test objects",
    "unseen": "fixed objects of kinds never seen",
}


@dataclass(frozen=True)
class SeededObject:
    """Random object, reproducible from its seed."""

    name: str
    category: str
    depth_m: Float32
    """(64, 64); NaN for background."""


Subject = SeededObject | shapes.BenchmarkObject
"""Object with a known depth map, a category, and a name for tables and pictures."""


def seeded_objects(first_seed: int, count: int, box: ObjectBox) -> list[SeededObject]:
    """Return random objects of consecutive seeds."""
    seeds = range(first_seed, first_seed + count)
    objects = [(seed, *shapes.object_depth(seed, box)) for seed in seeds]
    return [
        SeededObject(f"{category} {seed}", category, depth_m) for seed, category, depth_m in objects
    ]


def truth_of(subjects: Sequence[Subject], box: ObjectBox) -> Float32:
    """Return the true images v (n, 64, 64)."""
    return np.stack([shapes.image_from_depth(subject.depth_m, box) for subject in subjects])


def sensor_of(record: CheckpointRecord, rig: Rig) -> SensorModel:
    """Return the sensor under which weights are measured on a rig: the simulated camera's, at the
    gain of their training where their maps are not aligned, which would take it out.
    """
    counts = record.bare_wall_counts
    if counts is None or rig_to_align_with(rig, record) is not None:
        return SensorModel()
    return SensorModel(bare_wall_counts=counts)


def echoes_of(
    subjects: Sequence[Subject], rig: Rig, on_progress: OnProgress, pulse_ns: float = 0.0
) -> list[MultiBounce]:
    """Render the echoes of each object on a rig, without a sensor but for its pulse."""
    echoes: list[MultiBounce] = []
    for subject in subjects:
        echoes.append(render(Scene(rig, subject.depth_m, pulse_ns=pulse_ns)).multi)
        on_progress(len(echoes), len(subjects))
    return echoes


def sense(
    echoes: list[MultiBounce], rig: Rig, sensor: SensorModel | None = None, frames: int = 1
) -> list[LidarMaps]:
    """Return each object's maps as `live` forms them: sensor, reduction to cells, mean over
    `frames` frames.

    The frames equal the simulated camera's bit for bit, so that the same call gives the same maps.
    """
    scene = SceneFile(name="test objects", rig=rig, sensor=sensor or SensorModel())
    world = World(scene, echoes, [None])
    return [
        _averaged(world, range(k, k + frames * len(echoes), len(echoes)))
        for k in range(len(echoes))
    ]


def _averaged(world: World, numbers: Sequence[int]) -> LidarMaps:
    mean = MapMean(len(numbers))
    frames = (world.images(number).frame(world.rig.pinhole) for number in numbers)
    return [mean.add(maps_from_frame(frame)) for frame in frames][-1]


def reconstruct_all(reconstructor: Reconstructor, maps: MapSet) -> Float32:
    """Reconstruct images v (n, 64, 64), one object at a time as `live` does."""
    return answer_all(reconstructor, maps).image


def answer_all(reconstructor: Reconstructor, maps: MapSet) -> Answer:
    """Return images and, where the network has one, the probability of a surface, one object at a
    time.
    """
    pairs = zip(maps.depth_m, maps.intensity, strict=True)
    answers = [ask(reconstructor, depth_m[None], intensity[None]) for depth_m, intensity in pairs]
    surfaces = [answer.surface for answer in answers if answer.surface is not None]
    return Answer(
        np.concatenate([answer.image for answer in answers]),
        np.concatenate(surfaces) if surfaces else None,
    )


def predict_quality(
    answers: Answer, maps: MapSet, uncertainty_model: UncertaintyModel | None, rig: Rig
) -> Predictions | None:
    """Return the predicted quality of a network's answers to raw maps; None without a quality
    model.

    A frame is trusted as on the page: a detected object, on a verdict from this frame alone, of a
    trusted quality.
    """
    if uncertainty_model is None or uncertainty_model.quality is None:
        return None
    rows = list[tuple[float, ...]]()
    box = shapes.object_box(rig)
    surfaces = [None] * len(answers.image) if answers.surface is None else answers.surface
    for depth_m, intensity, image, surface in zip(
        maps.depth_m, maps.intensity, answers.image, surfaces, strict=True
    ):
        frame = LidarMaps(depth_m, intensity, ~np.isnan(depth_m))
        uncertainty = estimate_uncertainty(uncertainty_model, frame, image, box, surface)
        found = Reconstruction(
            shapes.depth_from_image(image, box), box, uncertainty.error_m, {}, uncertainty
        )
        _, verdict = VerdictFilter(verdict_limits(uncertainty_model)).decide(
            found, FrameConditions()
        )
        if quality := uncertainty.quality:
            trusted = quality.trusted and verdict is Verdict.SEEN
            rows.append((*quality.iou, 1e3 * quality.error_m, trusted))
        else:  # no surface: no overlap
            rows.append((0.0, 0.0, 0.0, 0.0, False))
    low, middle, high, error_mm, trusted = np.array(rows, np.float64).reshape(-1, 5).T
    return Predictions(low, middle, high, error_mm, trusted > 0)


@dataclass(frozen=True)
class HeldOutObjects:
    """Held-out objects that weights are measured on."""

    description: str
    """Sentence for the report."""
    names: list[str]
    categories: list[str]
    maps: MapSet
    """Raw maps, whichever input the weights expect: the baselines compare these."""
    plan: data.DatasetPlan
    benches: list[Rig]
    """The rig of each object."""
    recorded: MapSet | None = None
    """Maps as a lidar measured them, from which difference maps are made; None where `maps` are."""
    dataset: data.Dataset | None = None
    """Dataset that they are of; None for rendered ones."""

    def input_of(self, record: CheckpointRecord, bare: data.BareMaps | None) -> MapSet:
        """Return the maps that the network takes; see `network_input`."""
        maps = self.recorded if bare and self.recorded else self.maps
        return network_input(maps, bare, self.benches, record)


def rig_of(record: CheckpointRecord) -> Rig:
    """Return the rig that weights were trained for: a bench's own hold it, others name it; of
    weights for any rig, the paper's.

    Raises SceneError if a named one is neither packaged nor a file here.
    """
    if record.rig:
        if own := own_rig(record):
            return own
        raise SceneError(
            f"the weights were trained for {record.rig_name}, whose rig another version of nlos-cam"
            " wrote: give one with --rig"
        )
    if grid_of(record):
        return rig_named("paper-rig")
    try:
        return rig_named(record.rig_name)
    except RecordFileError as error:
        raise SceneError(
            f"the weights were trained for rig {record.rig_name!r}, which was not found ({error}):"
            " give one with --rig"
        ) from error


def rendered_objects(
    rig: Rig,
    count: int | None = None,
    tracked: Tracked = untracked,
    *,
    test: TestSet = "kinds",
    sensor: SensorModel | None = None,
) -> HeldOutObjects:
    """Render the 54 test objects of a set, or `count` random ones, with a sensor's noise (the
    simulated camera's by default) on a rig.
    """
    sensor = sensor or SensorModel()
    plan = data.DatasetPlan(rig, data.TEST_SEED, sensor)
    fixed = shapes.benchmark_objects if test == "kinds" else shapes.unseen_objects
    subjects = seeded_objects(plan.first_seed, count, plan.box) if count else fixed(plan.box)
    with tracked("rendering test objects") as on_progress:
        echoes = echoes_of(subjects, rig, on_progress, sensor.pulse_ns)
    maps = as_map_set(sense(echoes, rig, sensor), truth_of(subjects, plan.box))
    kind = "random objects" if count else TEST_SETS[test]
    description = f"{len(subjects)} held-out {kind}, with the sensor's noise"
    names = [one.name for one in subjects]
    categories = [one.category for one in subjects]
    return HeldOutObjects(description, names, categories, maps, plan, [rig] * len(names))


def dataset_objects(folder: Path) -> HeldOutObjects:
    """Return the objects and maps of a dataset; of many rigs without those that see too little of
    the wall, as in training.
    """
    opened = data.open_dataset(folder)
    categories = [str(category) for category in opened.column("category")]
    names = [
        f"{category} {seed}"
        for category, seed in zip(categories, opened.column("seed"), strict=True)
    ]
    recorded = opened.as_recorded()
    found = HeldOutObjects(
        f"Maps of {folder}",
        names,
        categories,
        opened.arrays(),
        opened.plan,
        [*opened.benches()],
        recorded=None if recorded is opened else recorded.arrays(),
        dataset=opened,
    )
    return found if opened.plan.rigs is None else _seen_on_the_grid(found)


def _seen_on_the_grid(objects: HeldOutObjects) -> HeldOutObjects:
    """Return the objects on rigs that can be aligned with the wall grid. Raises SceneError where none
    is.
    """
    # objects of one rig follow each other
    runs = [(rig, len([*same])) for rig, same in groupby(objects.benches)]
    seen = np.repeat([can_align(rig, WALL_GRID) for rig, _ in runs], [count for _, count in runs])
    if seen.all():
        return objects
    if not seen.any():
        raise SceneError(
            f"{objects.description}: all are of lidars that see too little of the wall; build others"
        )
    kept = np.flatnonzero(seen)
    arrays = [values[kept] for values in vars(objects.maps).values()]
    return replace(
        objects,
        description=f"{objects.description}, {(~seen).sum()} left out that see too little of the wall",
        names=[objects.names[k] for k in kept],
        categories=[objects.categories[k] for k in kept],
        maps=MapSet(*arrays),
        benches=[objects.benches[k] for k in kept],
    )


def bare_wall_for(
    record: CheckpointRecord, plan: data.DatasetPlan, wall: Path | None = None
) -> data.BareMaps | None:
    """Return the bare wall to subtract for difference maps, as in training; None if the weights
    expect raw maps.

    Raises SceneError if a measured wall was given for raw maps.
    """
    if record.input == "raw maps":
        if wall:
            raise SceneError(
                f"--wall {wall} only applies to difference maps; these weights expect raw maps:"
                " omit it"
            )
        return None
    return data.measured_bare_wall(wall) if wall else data.render_bare_wall(plan)


def network_input(
    maps: MapSet, bare: data.BareMaps | None, benches: Iterable[Rig], record: CheckpointRecord
) -> MapSet:
    """Return the maps that the network takes: minus the bare wall, or raw and aligned with the rig
    of the weights.
    """
    return subtract_bare_wall(maps, *bare) if bare else align_all(maps, benches, record)


def baseline_answers(
    objects: HeldOutObjects, training: Path | None, *, nearest: bool, tracked: Tracked = untracked
) -> tuple[dict[str, Float32], data.Dataset | None]:
    """Return the baselines' images by name, and the training objects searched for the nearest
    neighbour, if wanted. Raises SceneError where objects of a dataset are among those.
    """
    first_seed = _first_training_seed(objects.dataset)
    if not nearest:
        images = data.procedural_images(first_seed, trivial.NEIGHBOURS, objects.plan.box)
        return trivial.trivial_answers(len(objects.names), trivial.mean_image(images)), None
    if training:
        opened = data.open_dataset(training)
        if objects.dataset:
            data.check_held_out(opened, objects.dataset)
    else:
        with tracked("rendering training objects for the nearest neighbour, once") as on_progress:
            opened = trivial.training_maps(
                objects.plan, cache_folder(), os.cpu_count() or 1, on_progress, first_seed
            )
    with tracked("searching the nearest neighbours") as on_progress:
        if objects.plan.rigs is None and opened.plan.rigs is None:
            return trivial.answers_with_nearest(objects.maps, opened, on_progress), opened
        # maps of two rigs are compared where both see the same points of the wall
        sought = trivial.on_wall_grid(objects.maps, objects.benches)
        return trivial.answers_with_nearest(sought, opened, on_progress, on_grid=True), opened


def _first_training_seed(dataset: data.Dataset | None) -> int:
    """Return the first of NEIGHBOURS seeds of training objects that are none of a dataset's: among
    them each object would be its own nearest neighbour.
    """
    first = data.TRAINING_SEED
    if dataset is None or dataset.plan.accuracy == data.RECORDED:  # their seeds number frames
        return first
    taken = dataset.seeds
    while not taken.isdisjoint(range(first, first + trivial.NEIGHBOURS)):
        first += trivial.NEIGHBOURS
    return first


def notes_about(
    record: CheckpointRecord, objects: HeldOutObjects, training: data.Dataset | None
) -> list[str]:
    """List mismatches between weights, objects and baselines that a reader of the figures has to
    know.
    """
    rig = objects.plan.rig
    notes = _notes_about_rig(record, objects.plan)
    if training and training.plan.rig.checksum != rig.checksum:
        notes.append(
            f"the nearest neighbours come from {training.folder}, whose maps are of another rig"
        )
    if training and objects.plan.accuracy == data.RECORDED != training.plan.accuracy:
        notes.append(
            "the maps were recorded; the objects of the nearest neighbour are rendered for their rig"
        )
    if data.TRAINING_SEED <= objects.plan.first_seed < data.HELD_OUT_SEED and not (
        objects.plan.objects.meshes or objects.plan.accuracy == data.RECORDED
    ):
        notes.append(
            f"the objects have seeds of training ({objects.plan.first_seed} on): these weights may"
            f" have seen them; build others from --seed {data.HELD_OUT_SEED} on"
        )
    if unseen := sorted(set(left_out_categories(record)) & set(objects.categories)):
        notes.append(f"the weights' VAE was trained without {', '.join(unseen)}")
    return notes


def _notes_about_rig(record: CheckpointRecord, plan: data.DatasetPlan) -> list[str]:
    """List what a reader has to know of the rigs of weights and maps."""
    rig = plan.rig
    notes = list[str]()
    if grid_of(record) is not None:
        own = own_rig(record)
        if own is None:
            notes.append("the weights are for any rig: maps are aligned with the grid on the wall")
        elif rig_difference(rig, own):
            notes.append(
                f"the weights were trained for rig {own.name} but the maps are of rig {rig.name};"
                " both are aligned with the grid on the wall"
            )
    elif record.rig_checksum != rig.checksum:
        aligned = ", and aligned with it" if rig_to_align_with(rig, record) else ""
        notes.append(
            f"the weights were trained for rig {record.rig_name} but the maps are of rig"
            f" {rig.name}{aligned}"
        )
    if plan.rigs:
        aligned = "" if grid_of(record) else f", and aligned with {rig.name} where possible"
        notes.append(f"each object is on a rig of its own, of all that the paper allows{aligned}")
    elif plan.spread != data.RigSpread():
        notes.append(
            f"each object is on a rig of its own around {rig.name}, and aligned with it where"
            " possible"
        )
    return notes


def left_out_categories(record: CheckpointRecord) -> list[str]:
    """Return the categories that the weights' VAE was trained without."""
    return record.vae_recipe.left_out if record.vae_recipe else []
