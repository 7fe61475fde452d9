"""Benches near the one that networks were trained for: a lidar that stands a little off, other light, biased depth."""

from typing import NamedTuple

import numpy as np
from nlos_calibration.rig import Rig

from nlos_cam.render.sensor.model import SensorModel

Generator = np.random.Generator


class Spread(NamedTuple):
    """How far a bench may lie from the given one; each is drawn evenly up to it."""

    place_m: float
    angle_deg: float
    gain: float
    """Of the logarithm of the counts, to either side."""
    ambient_counts: float
    offset_m: float
    ripple_m: float
    patch_m: float
    texture: float


SLIGHT = Spread(0.0005, 0.1, 0.05, 10.0, 0.001, 0.0005, 0.0003, 0.03)
"""What a good calibration leaves: objects look as they did."""
WIDE = Spread(0.004, 0.6, 0.7, 60.0, 0.006, 0.003, 0.002, 0.2)
"""What an empty bench may do without showing an object."""
WITHOUT_OCCLUDER = 0.1
"""Of wide benches, the share that has no occluder: a wall alone hides nothing."""


def moved(rig: Rig, place_m: float, yaw_deg: float, pitch_deg: float) -> Rig:
    """The rig with its lidar so much farther from the wall, and turned by so much."""
    lidar = rig.lidar.model_copy(
        update={
            "distance_m": rig.lidar.distance_m + place_m,
            "yaw_deg": rig.lidar.yaw_deg + yaw_deg,
            "pitch_deg": rig.lidar.pitch_deg + pitch_deg,
        }
    )
    return rig.model_copy(update={"lidar": lidar})


def varied(rig: Rig, sensor: SensorModel, spread: Spread, generator: Generator) -> tuple[Rig, SensorModel]:
    """A bench near the given one."""
    place, yaw, pitch, gain, offset = generator.uniform(-1, 1, 5).tolist()
    ambient, ripple, patch, texture = generator.uniform(0, 1, 4).tolist()
    changed = sensor.model_copy(
        update={
            "bare_wall_counts": sensor.bare_wall_counts * float(np.exp(gain * spread.gain)),
            "ambient_counts": ambient * spread.ambient_counts,
            "range_offset_m": offset * spread.offset_m,
            "ripple_m": ripple * spread.ripple_m,
            "patch_drift_m": patch * spread.patch_m,
            "wall_texture": texture * spread.texture,
        }
    )
    angles = yaw * spread.angle_deg, pitch * spread.angle_deg
    return moved(rig, place * spread.place_m, *angles), changed


def varied_empty(rig: Rig, sensor: SensorModel, generator: Generator) -> tuple[Rig, SensorModel]:
    """A bench with nothing hidden: from the given one to one that lies widely off, and some without an occluder."""
    share = float(generator.choice([0.0, generator.random(), 1.0]))
    spread = Spread(*(share * most for most in WIDE))
    bench, seen_by = varied(rig, sensor, spread, generator)
    if generator.random() < WITHOUT_OCCLUDER:
        bench = bench.model_copy(update={"occluder": None})
    return bench, seen_by
