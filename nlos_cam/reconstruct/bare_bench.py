"""Bench with nothing hidden, as the renderer sees it: its light, and the cells that see its wall."""

from functools import lru_cache

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float64, Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS
from nlos_cam.render import Rendering, Scene, cast, render


@lru_cache(maxsize=4)
def bare_rendering(rig: Rig) -> Rendering:
    """Return the rendering of a rig with nothing hidden, which every check of a frame compares
    with.
    """
    return render(Scene(rig))


def brightest_light(rig: Rig) -> float:
    """Return the renderer's light of the brightest bare-wall return: `bare_wall_counts` of a sensor
    over it are its counts for each unit of light.
    """
    return float(cast(rig, rig.pinhole, occluder=False).direct.max())


def cells_on_wall(rig: Rig) -> Mask:
    """Return the cells (64, 80) that see the wall alone: those whose middle beam meets it, as do
    their four neighbors', since depth and light of an edge are not known.
    """
    on_wall = cast(rig, rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)).on_wall
    return interior(on_wall.reshape(MAP_ROWS, MAP_COLUMNS))


def wall_as_rendered(rig: Rig) -> tuple[Float64, Float64]:
    """Return depth along the optical axis in metres and light (64, 80) of the cells that see the
    wall alone; NaN and 0 elsewhere.
    """
    bare = bare_rendering(rig)  # pyright: ignore[reportArgumentType]  frozen, so hashable
    sees_wall = cells_on_wall(rig) & (bare.intensity > 0)
    return np.where(sees_wall, bare.depth_m, np.nan), np.where(sees_wall, bare.intensity, 0.0)


def interior(region: Mask) -> Mask:
    """Return the cells of a region (64, 80) whose four neighbors belong to it too."""
    found = region.copy()
    found[1:] &= region[:-1]
    found[:-1] &= region[1:]
    found[:, 1:] &= region[:, :-1]
    found[:, :-1] &= region[:, 1:]
    return found
