"""One trial of the wall fit: a wall drawn at random, looked at, measured, held against the truth."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot

import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import DepthMean
from nlos_calibration.rig import LidarPose, PinholeRecord, load_rig
from nlos_calibration.wall import INTERVAL_STDS, TOLERANCE_DEG, TOLERANCE_M, WallFit, fit_wall

from nlos_cam.calibrate.synthetic import (
    View,
    bent,
    curved,
    looked_at,
    patch,
    patchy,
    rippled,
    stepped,
    view,
    window,
    with_outliers,
)
from nlos_cam.render.echoes import MultiBounce
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import Sensor

Generator = np.random.Generator

DISTANCES_M, FACING_DEG, PITCHES_DEG = (0.15, 0.20, 0.25, 0.30), (15.0, 30.0, 45.0, 60.0, 75.0), (-12.0, 0.0, 8.0)
BARE = load_rig("bare-wall")
SIZE = 160, 120
SENSOR_SIZE = 320, 240
EMPTY = np.zeros((64, 80), np.float32)
NO_ECHO = MultiBounce(EMPTY, EMPTY, np.full((64, 80), np.nan, np.float32))


@dataclass(frozen=True)
class Setting:
    """What is looked at, and how."""

    scene: str = "bare"
    """A key of `SCENES`, or `sensor`: the simulated camera's own."""
    noise: float = 1.0
    """Over the nominal."""
    outliers: float = 0.0
    """Share of pixels that read anything, the same in each frame."""
    flicker: float = 0.0
    """Share of samples that read anything, others in each frame."""
    frames: int = 8


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    where: tuple[float, float]
    """Distance (m) and facing angle (degrees) that were drawn."""
    refused: str = ""
    verdict: str = ""
    distance_error_m: float = np.nan
    facing_error_deg: float = np.nan
    turn_deg: float = np.nan
    """Between the normal and the true one."""
    inside: tuple[bool, bool, bool, bool] = (False, False, False, False)
    """Whether distance, facing angle, yaw and pitch are in their stated 95 % interval."""

    @property
    def wrong(self) -> bool:
        """A plane that is off by more than it may be."""
        return abs(self.distance_error_m) > TOLERANCE_M or self.turn_deg > TOLERANCE_DEG

    @property
    def wrong_and_good(self) -> bool:
        """What must never be."""
        return self.verdict == "good" and self.wrong


def _bare(seen: View, generator: Generator) -> tuple[Float64, View]:
    del generator
    return seen.depth_m, seen


def _no_return(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Part of the view, from one side, gives nothing."""
    rows, columns = _image(seen)
    way, share = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(0.2, 0.7)
    along = columns * np.cos(way) + rows * np.sin(way)
    return np.where(along > np.quantile(along, 1.0 - share), np.nan, seen.depth_m), seen


def _image(seen: View) -> tuple[Float64, Float64]:
    """Row and column (height, width), each over the image's width."""
    rows, columns = np.indices(seen.depth_m.shape) / seen.depth_m.shape[1]
    return rows, columns


def _other_surface(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Something stands before the wall, square to the lidar."""
    rows, columns = _image(seen)
    way, share = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(0.02, 0.5)
    along = columns * np.cos(way) + rows * np.sin(way)
    near_m = generator.uniform(0.08, 0.5)
    return np.where(along > np.quantile(along, 1.0 - share), near_m, seen.depth_m), seen


def _bent(seen: View, generator: Generator) -> tuple[Float64, View]:
    """From a fifth of a degree to eight."""
    return _fold(seen, generator, 10.0 ** generator.uniform(-0.7, 0.9))


def _corner(seen: View, generator: Generator) -> tuple[Float64, View]:
    return _fold(seen, generator, generator.uniform(8.0, 110.0))


def _fold(seen: View, generator: Generator, bend_deg: float) -> tuple[Float64, View]:
    """Either way; drawn anew where the second wall would pass behind the lidar."""
    share, way, sign = generator.uniform(0.05, 0.95), generator.uniform(0.0, 2.0 * np.pi), generator.choice([-1, 1])
    try:
        return bent(seen, float(sign * bend_deg), float(share), float(way))
    except ValueError:
        return _fold(seen, generator, bend_deg)


def _curved(seen: View, generator: Generator) -> tuple[Float64, View]:
    radius_m = 10.0 ** generator.uniform(0.0, 2.2) * generator.choice([-1, 1])
    return curved(seen, radius_m, generator.uniform(0.0, np.pi)), seen


def _stepped(seen: View, generator: Generator) -> tuple[Float64, View]:
    height_m = 10.0 ** generator.uniform(-3.3, -1.3) * generator.choice([-1, 1])
    return stepped(seen, height_m, generator.uniform(0.05, 0.5), generator.uniform(0.0, 2.0 * np.pi)), seen


def _window(seen: View, generator: Generator) -> tuple[Float64, View]:
    return window(seen, 10.0 ** generator.uniform(-3.3, -1.0), int(generator.choice([4, 12, 30]))), seen


def _mirror(seen: View, generator: Generator) -> tuple[Float64, View]:
    mirrored = patch(seen, generator.uniform(0.02, 0.45))
    return np.where(mirrored, seen.depth_m * generator.uniform(1.5, 5.0), seen.depth_m), seen


def _saturated(seen: View, generator: Generator) -> tuple[Float64, View]:
    """In the middle the depth is too short."""
    spot = patch(seen, generator.uniform(0.02, 0.45))
    return np.where(spot, seen.depth_m - 10.0 ** generator.uniform(-3.3, -1.0), seen.depth_m), seen


def _rippled(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Up to 2 mm high."""
    return rippled(seen, generator.uniform(0.0002, 0.002), generator.uniform(2.5, 12.0), generator), seen


def _patchy(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Up to 1 mm."""
    return patchy(seen, generator.uniform(0.0002, 0.001), generator), seen


def _stuck(seen: View, generator: Generator) -> tuple[Float64, View]:
    return np.full(seen.depth_m.shape, generator.uniform(0.1, 1.0)), seen


HARD: dict[str, Callable[[View, Generator], tuple[Float64, View]]] = {
    "another surface": _other_surface,
    "bent": _bent,
    "corner": _corner,
    "curved": _curved,
    "mirror": _mirror,
    "saturated": _saturated,
    "stepped": _stepped,
    "stuck": _stuck,
    "window": _window,
}
SCENES = {"bare": _bare, "no return": _no_return, "rippled": _rippled, "patchy": _patchy, **HARD}


def drawn(generator: Generator, pinhole: Intrinsics) -> View:
    """A view of a wall on the grid of distances and angles, turned to either side."""
    distance_m, facing_deg = generator.choice(DISTANCES_M), generator.choice(FACING_DEG)
    pitch_deg = generator.choice([pitch for pitch in PITCHES_DEG if abs(pitch) < facing_deg])
    # cos(facing) = cos(yaw) cos(pitch)
    yaw_deg = np.degrees(np.arccos(np.cos(np.radians(facing_deg)) / np.cos(np.radians(pitch_deg))))
    return view(float(distance_m), float(yaw_deg * generator.choice([-1, 1])), float(pitch_deg), pinhole)


def trial(setting: Setting, generator: Generator) -> Outcome:
    """Draw a wall, look at it, measure it."""
    width, height = SENSOR_SIZE if setting.scene == "sensor" else SIZE
    seen = drawn(generator, BARE.pinhole.scaled(width, height))
    if setting.scene == "sensor":
        truth, mean = seen, sensed(seen, setting, generator)
    else:
        depth_m, truth = SCENES[setting.scene](seen, generator)
        still = setting.scene == "stuck"
        depth_m = with_outliers(depth_m, setting.outliers, generator)
        noise, frames = (0.0 if still else setting.noise), setting.frames
        mean = looked_at(depth_m, generator, frames=frames, noise=noise, flicker=setting.flicker)
    where = float(seen.pose[2, 3]), seen.facing_deg
    try:
        fit = fit_wall(mean.mean_m(), seen.pinhole, generator, mean.noise())
    except WallRefusedError as error:
        return Outcome(where, refused=str(error))
    return held_against(fit, truth, where)


def sensed(seen: View, setting: Setting, generator: Generator) -> DepthMean:
    """Frames of the simulated camera's sensor: its depth, dead pixels, and confidence that decides what is depth."""
    yaw, pitch = np.degrees(np.arctan2(seen.pose[2, 0], -seen.pose[2, 2])), np.degrees(np.arcsin(-seen.pose[2, 1]))
    lidar = LidarPose(distance_m=seen.pose[2, 3], yaw_deg=yaw, pitch_deg=pitch)
    pinhole = PinholeRecord.model_validate(vars(seen.pinhole))
    model = SensorModel()
    noisier = {name: setting.noise * getattr(model, name) for name in ("range_noise_m", "range_noise_per_m")}
    rig = BARE.model_copy(update={"lidar": lidar, "intrinsics": pinhole})
    sensor, mean = Sensor(rig, model.model_copy(update=noisier)), DepthMean(*seen.depth_m.shape)
    for _ in range(setting.frames):
        frame_m = sensor.expose(NO_ECHO, generator).frame(seen.pinhole).depth_m
        mean.add(with_outliers(frame_m.astype(np.float64), setting.flicker, generator))
    return mean


def held_against(fit: WallFit, truth: View, where: tuple[float, float]) -> Outcome:
    """The fit's errors, and whether it allowed for them."""
    normal = truth.pose[2, :3]
    yaw_deg, pitch_deg = np.degrees(np.arctan2(normal[0], -normal[2])), np.degrees(np.arcsin(-normal[1]))
    errors = (
        (fit.distance_m - truth.pose[2, 3], fit.distance_std_m),
        (fit.facing_deg - truth.facing_deg, fit.facing_std_deg),
        (fit.yaw_deg - yaw_deg, fit.yaw_std_deg),
        (fit.pitch_deg - pitch_deg, fit.pitch_std_deg),
    )
    across = np.cross(fit.wall_from_lidar[2, :3], normal)
    return Outcome(
        where,
        verdict=fit.verdict,
        distance_error_m=float(errors[0][0]),
        facing_error_deg=float(errors[1][0]),
        turn_deg=float(np.degrees(np.arcsin(min(hypot(*across), 1.0)))),
        inside=tuple(bool(abs(error) <= INTERVAL_STDS * std) for error, std in errors),
    )
