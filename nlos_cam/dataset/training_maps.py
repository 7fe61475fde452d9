"""What `train` reads before it starts: recipes, maps that fit them, and the bare wall for difference maps."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from nlos_calibration import Moments, load_measured
from nlos_calibration.arrays import Float16, Float32
from nlos_models import InMemory, MapBatch, MapSet, MapSource, Recipe, first_of, less_bare_wall

from nlos_cam.dataset import build
from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, maps_from_frame
from nlos_cam.render import Scene, Sensor, render

BARE_WALL_FRAMES = 60
"""As many as `calibrate` takes."""

BareMaps = tuple[Float32, Float32]
"""Depth and intensity, each (64, 80)."""


class TrainingMaps(NamedTuple):
    """Maps to learn from and to be judged by, of one rig."""

    training: MapSource
    held_out: MapSet
    plan: build.DatasetPlan

    @property
    def digest(self) -> str:
        """A word for the rig and for the objects to learn from: a run on others is another run."""
        return hashlib.sha256(self.plan.rig.checksum.encode() + self.training.image.tobytes()).hexdigest()

    def told(self, recipe: Recipe) -> Recipe:
        """The recipe with as many objects to judge by as there are, which may be fewer than it asks for."""
        return recipe.model_copy(update={"held_out": len(self.held_out.image)})


@dataclass(frozen=True)
class Streamed:
    """A dataset on the disk as a source; `bare` is subtracted from its maps if there is one."""

    dataset: build.Dataset
    image: Float16
    """All images (n, 64, 64)."""
    bare: BareMaps | None = None

    def first(self, count: int) -> MapSet:
        """The first `count` objects, in memory."""
        parts, held = list[MapSet](), 0
        for chunk in self.dataset.chunks():
            parts.append(chunk)
            if (held := held + len(chunk.image)) >= count:
                break
        arrays = (np.concatenate([getattr(part, name) for part in parts])[:count] for name in build.MAP_CHANNELS)
        maps = MapSet(*arrays)
        return less_bare_wall(maps, *self.bare) if self.bare else maps

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
        """One epoch, by a seed that the generator gives."""
        seed = int(torch.randint(2**62, (1,), generator=generator))
        for made in self.dataset.batches(seed, 0, batch):
            yield _less(made, self.bare) if self.bare else made


def _less(batch: MapBatch, bare: BareMaps) -> MapBatch:
    """A batch less the bare wall, which is mirrored where the sample is."""
    depth_m, intensity = (
        torch.where(batch.mirrored[:, None, None], plain.flip(-2), plain) for plain in map(torch.from_numpy, bare)
    )
    difference_m = batch.depth_m - depth_m
    brighter = torch.where(torch.isnan(difference_m), 0.0, batch.intensity - intensity)
    return batch._replace(depth_m=difference_m, intensity=brighter)


def read_maps(
    recipe: Recipe, data: Path, held_out_data: Path, wall: Path | None, *, stream: bool = False
) -> TrainingMaps:
    """The maps that a recipe asks for. Raises SceneError where they are too few, of two rigs, or one and the same.

    A stream is of a whole dataset, of which no more than some shards are in memory at a time.
    """
    if wall and recipe.maps == "raw maps":
        raise SceneError(f"raw maps have nothing taken off, so that {wall} would do nothing: leave --wall out")
    if data.resolve() == held_out_data.resolve():
        raise SceneError(f"{data} is to learn from and to be judged by: give --held-out a dataset of other objects")
    training, judging = (build.open_dataset(of, colour=recipe.colour) for of in (data, held_out_data))
    plan, count = training.plan, len(training)
    if count < recipe.objects:
        raise SceneError(
            f"{data} holds {count} objects, the recipe asks for {recipe.objects}: build that many, or give --objects"
        )
    if plan.rig != judging.plan.rig:
        raise SceneError(f"{data} and {held_out_data} were rendered for different rigs: build one of them again")
    if stream and count != recipe.objects:
        raise SceneError(f"{data} holds {count} objects, and a stream is of all: give --objects {count}")
    bare = _bare_wall(plan, wall) if recipe.maps == "difference maps" else None
    held_out = first_of(judging.arrays(), recipe.held_out)
    if bare:
        held_out = less_bare_wall(held_out, *bare)
    return TrainingMaps(_source(training, recipe.objects, bare, stream=stream), held_out, plan)


def _source(training: build.Dataset, count: int, bare: BareMaps | None, *, stream: bool) -> MapSource:
    if stream:
        return Streamed(training, training.column("image"), bare)
    maps = first_of(training.arrays(), count)
    return InMemory(less_bare_wall(maps, *bare) if bare else maps)


def _bare_wall(plan: build.DatasetPlan, wall: Path | None) -> BareMaps:
    return measured_bare_wall(wall) if wall else render_bare_wall(plan)


def measured_bare_wall(path: Path) -> BareMaps:
    """Depth and intensity, each (64, 80), of a bench's bare wall, as `calibrate --wall` took it."""
    wall = load_measured(path).reference
    if wall is None:
        raise SceneError(f"{path} has no reference to form difference maps from: calibrate the wall again")
    return wall.map_depth_m, wall.map_intensity


def render_bare_wall(plan: build.DatasetPlan, frames: int = BARE_WALL_FRAMES) -> BareMaps:
    """Depth and intensity, each (64, 80), of a rig with nothing hidden: the mean of so many noisy frames.

    Raises SceneError where the rig differs from object to object: then no one wall is that of all.
    """
    if plan.spread != build.RigSpread():
        raise SceneError("this dataset's rig differs from object to object: difference maps need one rig, or --wall")
    sensor = Sensor(plan.rig, plan.sensor, plan.radiometry)
    echoes = render(Scene(plan.rig, radiometry=plan.radiometry), plan.accuracy).multi
    depth, intensity = (Moments((MAP_ROWS, MAP_COLUMNS)) for _ in range(2))
    for frame in range(frames):
        images = sensor.expose(echoes, np.random.default_rng([frame, 2]))
        maps = maps_from_frame(images.frame(plan.rig.pinhole))
        depth.add(maps.depth_m)
        intensity.add(np.where(maps.valid, maps.intensity, np.nan))
    return depth.mean().astype(np.float32), intensity.mean().astype(np.float32)
