"""One trial of the occluder's detection: a bench drawn at random, looked at, measured, held against the truth."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.errors import OccluderRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import DepthMean
from nlos_calibration.occluder import MIN_COLUMNS, OccluderFit, find_occluder
from nlos_calibration.rig import LidarPose, Occluder, PinholeRecord, load_rig
from wall_trials import NO_ECHO

from nlos_cam.calibrate.synthetic import Sheet, View, bench, looked_at, view, with_outliers
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import Sensor

Generator = np.random.Generator

SIZE = 160, 120
PAPER = load_rig("paper-rig")
PITCHES_DEG = -12.0, 0.0, 0.0, 8.0
SURE = 1.96
IN_VIEW, BARELY, NOT_IN_VIEW, EDGE_HIDDEN = "in view", "barely in view", "out of view", "edge out of view"


@dataclass(frozen=True)
class Setting:
    """About where the lidar and the sheet stand, and how they are looked at."""

    distance_m: float = 0.2
    facing_deg: float = 45.0
    x_m: float = 0.2
    gap_m: float = 0.1
    noise: float = 1.0
    """Over the nominal."""
    frames: int = 30
    beams: int = 1
    """Across a pixel: more than one mix on the edge."""
    outliers: float = 0.0
    """Share of pixels that read anything, the same in each frame."""
    lean_deg: float = 1.0
    """How far it leans, is twisted and its edge is off, at most."""


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    shown: str
    """How much of the sheet there was to see."""
    refused: str = ""
    x_error_m: float = np.nan
    gap_error_m: float = np.nan
    tilt_error_deg: float = np.nan
    inside: tuple[bool, bool, bool] = (False, False, False)
    """Whether x, gap and tilt are in their stated 95 % interval."""


def trial(setting: Setting, generator: Generator) -> Outcome:
    """Draw a bench near the setting, look at it, find its occluder."""
    seen, sheet = drawn(setting, generator)
    true_m = bench(seen, sheet, beams=setting.beams)
    depth_m = with_outliers(true_m, setting.outliers, generator)
    mean = looked_at(depth_m, generator, frames=setting.frames, noise=setting.noise)
    shown = how_much(seen, sheet)
    try:
        found = find_occluder(mean.mean_m(), mean.noise(), seen.pinhole, seen.pose, generator)
    except OccluderRefusedError as error:
        return Outcome(shown, refused=str(error))
    return outcome(shown, found, sheet)


def drawn(setting: Setting, generator: Generator) -> tuple[View, Sheet]:
    """A bench near the setting: so near that it is one, so far that no pixel's edge is special."""
    pinhole = PAPER.pinhole.scaled(*SIZE)
    distance_m = setting.distance_m + generator.uniform(-0.005, 0.005)
    yaw_deg = setting.facing_deg + generator.uniform(-1.0, 1.0)
    lean_deg, twist_deg, edge_deg = generator.uniform(-setting.lean_deg, setting.lean_deg, 3)
    x_m, gap_m = setting.x_m + generator.uniform(-0.01, 0.01), setting.gap_m + generator.uniform(-0.005, 0.005)
    seen = view(distance_m, yaw_deg, float(generator.choice(PITCHES_DEG)), pinhole)
    return seen, Sheet(x_m, gap_m, lean_deg, twist_deg, edge_deg)


def how_much(seen: View, sheet: Sheet) -> str:
    """Whether there is anything to be found."""
    met = bench(seen, sheet) < bench(seen, None)
    columns = np.median(met.sum(axis=1))
    if met[:, 0].mean() > 0.5:
        return EDGE_HIDDEN
    return IN_VIEW if columns >= 2 * MIN_COLUMNS else BARELY if met.any() else NOT_IN_VIEW


def outcome(shown: str, found: OccluderFit, sheet: Sheet) -> Outcome:
    """The errors, and whether they are stated."""
    errors = found.x_m - sheet.x_m, found.gap_m - sheet.gap_m, found.tilt_deg - sheet.lean_deg
    stds = found.x_std_m, found.gap_std_m, found.tilt_std_deg
    x, gap, tilt = (abs(error) <= SURE * std for error, std in zip(errors, stds, strict=True))
    return Outcome(shown, "", *errors, inside=(x, gap, tilt))


def sensed(setting: Setting, generator: Generator, pinhole: Intrinsics) -> Outcome:
    """The same through the renderer's beams and the simulated camera's sensor; its sheet stands straight."""
    seen, sheet = drawn(setting, generator)
    sheet = Sheet(sheet.x_m, sheet.gap_m)
    rig = PAPER.model_copy(
        update={
            "lidar": LidarPose(distance_m=float(seen.pose[2, 3]), yaw_deg=setting.facing_deg),
            "intrinsics": PinholeRecord.model_validate(vars(pinhole)),
            "occluder": Occluder(x_m=sheet.x_m, z_min_m=sheet.gap_m),
        }
    )
    sensor, mean = Sensor(rig, SensorModel()), DepthMean(pinhole.height, pinhole.width)
    for _ in range(setting.frames):
        mean.add(sensor.expose(NO_ECHO, generator).frame(pinhole).depth_m)
    shown = how_much(View(rig.wall_from_lidar, pinhole), sheet)
    try:
        found = find_occluder(mean.mean_m(), mean.noise(), pinhole, rig.wall_from_lidar, generator)
    except OccluderRefusedError as error:
        return Outcome(shown, refused=str(error))
    return outcome(shown, found, sheet)
