"""Random benches with an occluder, measured from noisy depth, against the truth."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration import (
    INTERVAL_STDS,
    DepthMean,
    Intrinsics,
    LidarPose,
    Occluder,
    PinholeRecord,
    load_rig,
)
from nlos_calibration.errors import OccluderRefusedError
from nlos_calibration.occluder import MIN_COLUMNS, find_occluder
from synthetic_scenes import Sheet, bench_depth
from synthetic_walls import View, depth_statistics, view, with_outliers

from nlos_cam.render import MultiBounce, Sensor, SensorModel

Generator = np.random.Generator
DARK = np.zeros((64, 80), np.float32)
NO_ECHO = MultiBounce(DARK, DARK, np.full((64, 80), np.nan, np.float32))

PAPER = load_rig("paper-rig")
PINHOLE = PAPER.pinhole.scaled(96, 72)
PITCHES_DEG = -12.0, 0.0, 0.0, 8.0
IN_VIEW = "in view"
BARELY = "barely in view"
NOT_IN_VIEW = "out of view"
EDGE_HIDDEN = "edge out of view"


@dataclass(frozen=True)
class OccluderConditions:
    """Approximate pose of lidar and sheet, and conditions of the depth."""

    distance_m: float = 0.2
    facing_deg: float = 45.0
    x_m: float = 0.2
    gap_m: float = 0.1
    noise: float = 1.0
    """Over nominal."""
    frames: int = 30
    beams: int = 1
    """Beams across a pixel: more than one mix on the edge."""
    outliers: float = 0.0
    """Share of pixels with a random depth, the same in each frame."""
    lean_deg: float = 1.0
    """Largest lean, twist and tilt of the edge."""


@dataclass(frozen=True)
class Outcome:
    """Refusal or errors of one trial."""

    shown: str
    """Visibility of the sheet."""
    refused: str = ""
    x_error_m: float = np.nan
    gap_error_m: float = np.nan
    tilt_error_deg: float = np.nan
    inside: tuple[bool, bool, bool] = (False, False, False)
    """True for x, gap and tilt with the truth inside their 95 % interval."""


def draw(conditions: OccluderConditions, generator: Generator) -> tuple[View, Sheet]:
    """Return a bench near the conditions, at random against the pixels' grid."""
    yaw_deg = conditions.facing_deg + generator.uniform(-1.0, 1.0)
    distance_m = generator.uniform(-0.005, 0.005)
    lean_deg, twist_deg, edge_deg = generator.uniform(-conditions.lean_deg, conditions.lean_deg, 3)
    x_m = conditions.x_m + generator.uniform(-0.01, 0.01)
    gap_m = conditions.gap_m + generator.uniform(-0.005, 0.005)
    seen = view(
        conditions.distance_m + distance_m, yaw_deg, float(generator.choice(PITCHES_DEG)), PINHOLE
    )
    return seen, Sheet(x_m, gap_m, lean_deg, twist_deg, edge_deg)


def trial(conditions: OccluderConditions, generator: Generator) -> Outcome:
    """Draw a bench near the conditions and find its occluder."""
    seen, sheet = draw(conditions, generator)
    depth_m = with_outliers(
        bench_depth(seen, sheet, beams=conditions.beams), conditions.outliers, generator
    )
    mean = depth_statistics(depth_m, generator, frames=conditions.frames, noise=conditions.noise)
    return outcome(seen, sheet, mean, generator)


def simulated_trial(
    conditions: OccluderConditions, generator: Generator, pinhole: Intrinsics
) -> Outcome:
    """Find an upright occluder in frames of the renderer's beams and the simulated camera's
    sensor.
    """
    seen, leaning = draw(conditions, generator)
    sheet = Sheet(leaning.x_m, leaning.gap_m)
    rig = PAPER.model_copy(
        update={
            "lidar": LidarPose(distance_m=float(seen.pose[2, 3]), yaw_deg=conditions.facing_deg),
            "intrinsics": PinholeRecord.model_validate(vars(pinhole)),
            "occluder": Occluder(x_m=sheet.x_m, z_min_m=sheet.gap_m),
        }
    )
    sensor = Sensor(rig, SensorModel())
    mean = DepthMean(pinhole.height, pinhole.width)
    for _ in range(conditions.frames):
        mean.add(sensor.expose(NO_ECHO, generator).frame(pinhole).depth_m)
    return outcome(View(rig.wall_from_lidar, pinhole), sheet, mean, generator)


def outcome(seen: View, sheet: Sheet, mean: DepthMean, generator: Generator) -> Outcome:
    """Find the occluder and compare it with the truth."""
    on_sheet = bench_depth(seen, sheet) < bench_depth(seen, None)
    columns = np.median(on_sheet.sum(axis=1))
    shown = BARELY if on_sheet.any() else NOT_IN_VIEW
    if columns >= 2 * MIN_COLUMNS:
        shown = IN_VIEW
    if on_sheet[:, 0].mean() > 0.5:
        shown = EDGE_HIDDEN
    try:
        fit = find_occluder(mean.mean_m(), mean.noise(), seen.pinhole, seen.pose, generator)
    except OccluderRefusedError as error:
        return Outcome(shown, refused=str(error))
    errors = fit.x_m - sheet.x_m, fit.gap_m - sheet.gap_m, fit.tilt_deg - sheet.lean_deg
    stds = fit.x_std_m, fit.gap_std_m, fit.tilt_std_deg
    x, gap, tilt = (
        abs(error) <= INTERVAL_STDS * std for error, std in zip(errors, stds, strict=True)
    )
    return Outcome(shown, "", *errors, inside=(x, gap, tilt))
