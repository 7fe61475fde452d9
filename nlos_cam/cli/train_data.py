"""What `train` reads before it starts: recipes, maps that fit them, and the bare wall for difference maps."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from nlos_calibration.bare_wall import Moments
from nlos_calibration.measured_wall import load_measured
from nlos_models.data import MapSet
from nlos_models.recipe import Recipe, load_recipe
from nlos_models.sources import InMemory, MapSource, first_of, less_bare_wall

from nlos_cam import dataset
from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, Float32, maps_from_frame
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor import Sensor

BARE_WALL_FRAMES = 60
"""As many as `calibrate` takes."""


class TrainingMaps(NamedTuple):
    """Maps to learn from and to be judged by, of one rig."""

    training: MapSource
    held_out: MapSet
    plan: dataset.DatasetPlan


class RecipeChoice(NamedTuple):
    """A recipe's file, and how much of it is run."""

    path: Path
    budget: float = 1.0
    objects: int | None = None

    def read(self, task: str) -> Recipe:
        """The recipe. Raises SceneError where it is another task's."""
        recipe = load_recipe(self.path)
        if recipe.task != task:
            raise SceneError(f"{self.path} is a recipe for {recipe.task!r}, not {task!r}: choose another --recipe")
        if self.objects is not None:
            recipe = recipe.of_objects(self.objects)
        return recipe.scaled(self.budget)


def read_maps(recipe: Recipe, data: Path, held_out_data: Path, wall: Path | None) -> TrainingMaps:
    """The maps that a recipe asks for. Raises SceneError where they are too few, or of two rigs."""
    maps, plan = dataset.read(data)
    held_out, other = dataset.read(held_out_data)
    if len(maps.image) < recipe.objects:
        raise SceneError(
            f"{data} holds {len(maps.image)} objects, the recipe asks for {recipe.objects}: "
            "build that many, or give --objects"
        )
    if plan.rig != other.rig:
        raise SceneError(f"{data} and {held_out_data} were rendered for different rigs: build one of them again")
    maps, held_out = first_of(maps, recipe.objects), first_of(held_out, recipe.held_out)
    if recipe.maps == "difference maps":
        bare = measured_bare_wall(wall) if wall else render_bare_wall(plan)
        maps, held_out = less_bare_wall(maps, *bare), less_bare_wall(held_out, *bare)
    return TrainingMaps(InMemory(maps), held_out, plan)


def measured_bare_wall(path: Path) -> tuple[Float32, Float32]:
    """Depth and intensity, each (64, 80), of a bench's bare wall, as `calibrate --wall` took it."""
    wall = load_measured(path).reference
    if wall is None:
        raise SceneError(f"{path} has no reference to form difference maps from: calibrate the wall again")
    return wall.map_depth_m, wall.map_intensity


def render_bare_wall(plan: dataset.DatasetPlan, frames: int = BARE_WALL_FRAMES) -> tuple[Float32, Float32]:
    """Depth and intensity, each (64, 80), of a rig with nothing hidden: the mean of so many noisy frames."""
    sensor, echoes = Sensor(plan.rig, plan.sensor), render(Scene(plan.rig), plan.accuracy).multi
    depth, intensity = (Moments((MAP_ROWS, MAP_COLUMNS)) for _ in range(2))
    for frame in range(frames):
        images = sensor.expose(echoes, np.random.default_rng([frame, 2]))
        maps = maps_from_frame(images.frame(plan.rig.pinhole))
        depth.add(maps.depth_m)
        intensity.add(np.where(maps.valid, maps.intensity, np.nan))
    return depth.mean().astype(np.float32), intensity.mean().astype(np.float32)
