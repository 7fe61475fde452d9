"""Training maps of a recipe, in memory or streamed, and the bare wall that difference maps
subtract.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from nlos_calibration import Moments, Rig, load_measured
from nlos_calibration.arrays import Float16, Float32
from nlos_models import CheckpointRecord
from nlos_models.training import (
    InMemory,
    MapBatch,
    MapRecipe,
    MapSet,
    MapSource,
    Recipe,
    WithNoise,
    record_run,
    subtract_bare_wall,
)

from nlos_cam.dataset.packed import map_noise
from nlos_cam.dataset.packed_index import data_key
from nlos_cam.dataset.packing import rig_of_weights
from nlos_cam.dataset.plan import RECORDED, DatasetPlan, RigSpread
from nlos_cam.dataset.reader import Dataset, check_held_out, open_dataset
from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, maps_from_frame
from nlos_cam.reconstruct import (
    align_all,
    is_wall_grid,
    recorded_counts,
    rig_fields,
    rig_to_align_with,
    training_rig,
)
from nlos_cam.render import Scene, Sensor, render

BARE_WALL_FRAMES = 60
"""Frames to average: the default of `calibrate`."""

BareMaps = tuple[Float32, Float32]
"""Depth and intensity, each (64, 80)."""


class MapSplit(NamedTuple):
    """Training maps and held-out maps of one rig."""

    training: MapSource
    held_out: MapSet
    plan: DatasetPlan
    rig: Rig
    """The rig that the maps are of, or aligned with."""
    key: str
    """Key of the maps: other maps of the same objects have another."""

    @property
    def digest(self) -> str:
        """SHA-256 of rig, maps and training objects: a run with another one cannot be resumed."""
        decided = f"{self.rig.checksum}\n{self.key}\n"
        return hashlib.sha256(decided.encode() + self.training.image.tobytes()).hexdigest()

    def record_run(
        self,
        recipe: Recipe,
        out: Path,
        runs: list[Recipe],
        *starts: Path | None,
        trained: CheckpointRecord | None = None,
    ) -> CheckpointRecord:
        """Return the record of the weights that a recipe makes of these maps after `runs`, which
        began with weights `trained` where it is a transfer. Raises OutputExistsError as
        `nlos_models.training.record_run`.
        """
        rig = rig_of_weights(self.plan, self.rig, trained)
        start = trained if trained and trained.rig_checksum == self.rig.checksum else None
        counts = start.bare_wall_counts if start else recorded_counts(self.plan.sensor)
        on_grid = is_wall_grid(self.rig)
        bench = start.rig if start and not on_grid else None
        return record_run(
            recipe,
            out,
            (rig.name, self.rig.checksum),
            runs,
            *starts,
            bench=bench or rig_fields(rig, packaged=on_grid),
            bare_wall_counts=counts,
        )

    def limit_recipe(self, recipe: MapRecipe) -> MapRecipe:
        """Return the recipe with the number of held-out objects available, which may be lower than
        it requests.
        """
        return recipe.model_copy(update={"held_out": len(self.held_out.image)})


@dataclass(frozen=True)
class Streamed:
    """Map source that streams a dataset from disk, less the bare wall if there is one."""

    dataset: Dataset
    image: Float16
    """All images (n, 64, 64)."""
    bare: BareMaps | None = None

    def first(self, count: int) -> MapSet:
        """Return the first `count` objects, in memory."""
        maps = self.dataset.first(count)
        return subtract_bare_wall(maps, *self.bare) if self.bare else maps

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
        """Yield one epoch, shuffled by a seed from the generator."""
        seed = int(torch.randint(2**62, (1,), generator=generator))
        for raw in self.dataset.batches(seed, 0, batch):
            yield _subtract(raw, self.bare) if self.bare else raw


def _subtract(batch: MapBatch, bare: BareMaps) -> MapBatch:
    """Return a batch less the bare wall, which is mirrored where the sample is."""
    depth_m, intensity = (
        torch.where(batch.mirrored[:, None, None], plain.flip(-2), plain)
        for plain in map(torch.from_numpy, bare)
    )
    difference_m = batch.depth_m - depth_m
    brighter = torch.where(torch.isnan(difference_m), 0.0, batch.intensity - intensity)
    return batch._replace(depth_m=difference_m, intensity=brighter)


def read_maps(
    recipe: MapRecipe,
    data: Path,
    held_out_data: Path,
    wall: Path | None,
    *,
    stream: bool = False,
    start: CheckpointRecord | None = None,
) -> MapSplit:
    """Return the maps of a recipe. Raises SceneError where they are too few, of two rigs, or not
    held out.

    To expected maps the sensor's noise is added, in each epoch another draw. A stream reads the
    objects from disk and keeps a few shards in memory. Maps of another rig than that of the weights
    that a transfer has as its `start` are aligned with it; expected ones are refused.
    """
    if wall and recipe.maps == "raw maps":
        raise SceneError(
            f"--wall {wall} only applies to difference maps; this recipe uses raw maps"
        )
    dataset, other = _open_both(recipe, data, held_out_data)
    for each in (dataset, other):
        _check_one_rig(each.plan, recipe, start)
    plan = dataset.plan
    bare = None
    if recipe.maps == "difference maps":
        bare = measured_bare_wall(wall) if wall else render_bare_wall(plan)
    held_out = other.first(recipe.held_out)
    if bare:
        held_out = subtract_bare_wall(held_out, *bare)
    rig = plan.rig
    if start:
        rig = rig_to_align_with(rig, start) or rig
        if plan.expected and (plan.rigs or rig != plan.rig):
            raise SceneError(
                f"{data} holds expected maps, to which training adds the sensor's noise, but these"
                f" weights need maps aligned with {rig.name}, whose light is scaled: build them"
                " without --expected-maps"
            )
        held_out = align_all(held_out, other.benches(), start)
    source: MapSource
    if stream:
        used = dataset.up_to(recipe.objects)
        source = Streamed(used, used.column("image"), bare)
    else:
        maps = dataset.first(recipe.objects)
        maps = subtract_bare_wall(maps, *bare) if bare else maps
        source = InMemory(align_all(maps, dataset.benches(), start) if start else maps)
    training = WithNoise(source, map_noise(plan)) if plan.expected else source
    key = _key_of((dataset, other), bare if wall else None)
    return MapSplit(training, held_out, plan, rig, key)


def _key_of(datasets: Sequence[Dataset], measured: BareMaps | None) -> str:
    """Return the key of the maps of datasets, less a measured bare wall."""
    # A rendered bare wall follows from the plan, which `data_key` has.
    wall = hashlib.sha256()
    for values in measured or ():
        wall.update(values.tobytes())
    return "\n".join([*map(data_key, datasets), wall.hexdigest() if measured else ""])


def _check_one_rig(plan: DatasetPlan, recipe: MapRecipe, start: CheckpointRecord | None) -> None:
    """Raise SceneError for a dataset of many rigs whose maps nothing aligns with one."""
    if plan.rigs is None:
        return
    if recipe.maps == "difference maps":
        raise SceneError(
            "the rig of this dataset varies between objects, which have no bare wall in common:"
            " build it without --any-rig for difference maps"
        )
    if start is None or training_rig(start) is None:
        raise SceneError(
            "the rig of this dataset varies between objects, and nothing aligns their maps: build"
            " it without --any-rig, or train with `train direct`"
        )


def _open_both(recipe: MapRecipe, data: Path, held_out_data: Path) -> tuple[Dataset, Dataset]:
    """Open the datasets of training and held-out maps; of recordings, for difference maps, as the
    lidar measured them.
    """
    dataset = open_dataset(data, color=recipe.colour, expected=recipe.maps == "raw maps")
    other = open_dataset(held_out_data, color=recipe.colour)
    check_held_out(dataset, other)
    if len(dataset) < recipe.objects:
        raise SceneError(
            f"{data} holds {len(dataset)} objects, the recipe needs {recipe.objects}: build more,"
            " or lower --objects"
        )
    if dataset.plan.rig != other.plan.rig:
        raise SceneError(
            f"{data} and {held_out_data} were rendered for different rigs: build one of them again"
        )
    if recipe.maps == "difference maps":
        return dataset.as_recorded(), other.as_recorded()
    return dataset, other


def measured_bare_wall(path: Path) -> BareMaps:
    """Return depth and intensity, each (64, 80), of the bare wall that `calibrate --wall`
    recorded.
    """
    wall = load_measured(path).reference
    if wall is None:
        raise SceneError(
            f"{path} has no bare-wall reference for difference maps: calibrate the wall again"
        )
    return wall.map_depth_m, wall.map_intensity


def render_bare_wall(plan: DatasetPlan, frames: int = BARE_WALL_FRAMES) -> BareMaps:
    """Return depth and intensity, each (64, 80), of the rig with nothing hidden: the mean of some
    noisy frames.

    Raises SceneError where the rig varies between objects, which then have no bare wall in common,
    and for recordings, whose bare wall is the bench's own.
    """
    if plan.accuracy == RECORDED:
        raise SceneError(
            f"the maps of this dataset were recorded on {plan.rig.name}, whose bare wall cannot be"
            " rendered: give the bench's measured one with --wall"
        )
    if plan.spread != RigSpread() or plan.rigs:
        raise SceneError(
            "the rig of this dataset varies between objects: difference maps need one rig, or"
            " --wall"
        )
    sensor = Sensor(plan.rig, plan.sensor, plan.radiometry)
    # with the samples' pulse: the sensor's gain makes up for what it takes from the peaks
    bare = Scene(plan.rig, radiometry=plan.radiometry, pulse_ns=plan.sensor.pulse_ns)
    echoes = render(bare, plan.accuracy).multi
    depth, intensity = (Moments((MAP_ROWS, MAP_COLUMNS)) for _ in range(2))
    for frame in range(frames):
        images = sensor.expose(echoes, np.random.default_rng([frame, 2]))
        maps = maps_from_frame(images.frame(plan.rig.pinhole))
        depth.add(maps.depth_m)
        intensity.add(np.where(maps.valid, maps.intensity, np.nan))
    return depth.mean().astype(np.float32), intensity.mean().astype(np.float32)
