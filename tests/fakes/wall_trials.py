"""Random bare walls with noise, outliers and missing returns, measured against the truth."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nlos_calibration import INTERVAL_STDS, fit_wall, load_rig
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from synthetic_walls import View, depth_statistics, patchy, rippled, view, with_outliers

Generator = np.random.Generator

DISTANCES_M = (0.15, 0.20, 0.25, 0.30)
FACING_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)
PITCHES_DEG = (-12.0, 0.0, 8.0)
PINHOLE = load_rig("bare-wall").pinhole.scaled(80, 60)


def without_return(seen: View, generator: Generator) -> Float64:
    """Leave out the returns of 20 to 70 % of the image, on one side of a line in a random
    direction.
    """
    rows, columns = np.indices(seen.depth_m.shape) / seen.depth_m.shape[1]
    way = generator.uniform(0.0, 2.0 * np.pi)
    share = generator.uniform(0.2, 0.7)
    along = columns * np.cos(way) + rows * np.sin(way)
    return np.where(along > np.quantile(along, 1.0 - share), np.nan, seen.depth_m)


SCENES: dict[str, Callable[[View, Generator], Float64]] = {
    "bare": lambda seen, _: seen.depth_m,
    "no return": without_return,
    "rippled": lambda seen, g: rippled(seen, g.uniform(0.0002, 0.002), g.uniform(2.5, 12.0), g),
    "patchy": lambda seen, g: patchy(seen, g.uniform(0.0002, 0.001), g),
}


@dataclass(frozen=True)
class WallConditions:
    """Scene (a key of SCENES), noise over the nominal, shares of outliers and flicker, and
    frames.
    """

    scene: str = "bare"
    noise: float = 1.0
    outliers: float = 0.0
    flicker: float = 0.0
    frames: int = 8


def random_view(generator: Generator) -> View:
    """Return a view of a wall on the grid of distances and angles, turned to either side."""
    distance_m = generator.choice(DISTANCES_M)
    facing_deg = generator.choice(FACING_DEG)
    pitch_deg = generator.choice([pitch for pitch in PITCHES_DEG if abs(pitch) < facing_deg])
    # cos(facing) = cos(yaw) cos(pitch)
    yaw_deg = np.degrees(np.arccos(np.cos(np.radians(facing_deg)) / np.cos(np.radians(pitch_deg))))
    yaw_deg *= generator.choice([-1, 1])
    return view(float(distance_m), float(yaw_deg), float(pitch_deg), PINHOLE)


def trial(conditions: WallConditions, generator: Generator) -> dict[str, Any] | None:
    """Draw a wall and measure it; return errors and what lies inside its 95 % interval, None where
    it is refused.
    """
    seen = random_view(generator)
    depth_m = with_outliers(
        SCENES[conditions.scene](seen, generator), conditions.outliers, generator
    )
    mean = depth_statistics(
        depth_m,
        generator,
        frames=conditions.frames,
        noise=conditions.noise,
        flicker=conditions.flicker,
    )
    try:
        fit = fit_wall(mean.mean_m(), seen.pinhole, generator, mean.noise())
    except WallRefusedError:
        return None
    normal = seen.pose[2, :3]
    yaw_deg = np.degrees(np.arctan2(normal[0], -normal[2]))
    pitch_deg = np.degrees(np.arcsin(-normal[1]))
    errors = (
        (fit.distance_m - seen.pose[2, 3], fit.distance_std_m),
        (fit.facing_deg - seen.facing_deg, fit.facing_std_deg),
        (fit.yaw_deg - yaw_deg, fit.yaw_std_deg),
        (fit.pitch_deg - pitch_deg, fit.pitch_std_deg),
    )
    return {
        "facing_error_deg": float(errors[1][0]),
        "inside": [bool(abs(error) <= INTERVAL_STDS * std) for error, std in errors],
    }
