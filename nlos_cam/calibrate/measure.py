"""What a camera saw of a bench that stood still: the statistics of its frames, and what it was seen with.

From what was seen of a bare wall to its fit, by depth, tape and printed board, and what the record says of it.

A glance at the wall in a single frame, for somebody who is positioning the lidar: where it is, what to move.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from math import hypot

import numpy as np
from nlos_calibration import (
    TOLERANCE_DEG,
    TOLERANCE_M,
    BareWall,
    BareWallStatistics,
    Board,
    BoardView,
    Intrinsics,
    MeasuredWall,
    OccluderFit,
    WallByBoard,
    WallFit,
    WallRecord,
    depth_lacks_m,
    find_occluder,
    fit_wall,
    fit_with_tape_distance,
    points_m,
    settings_changed,
    wall_from_zero,
    wall_with_board,
    with_occluder,
)
from nlos_calibration.arrays import Float32
from nlos_calibration.errors import CalibrationError, WallRefusedError
from numpy.typing import NDArray

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame, maps_from_frame, saturated_share
from nlos_cam.reconstruct import check_intrinsics

CELSIUS_EVERY = 30
"""Frames between two looks at the thermometers: each costs a device a command."""


@dataclass(frozen=True)
class CaptureStatistics:
    """What was looked at, and by what."""

    camera: str
    """The URI."""
    statistics: BareWallStatistics
    intrinsics: Intrinsics
    serial: str
    firmware: str
    settings: Mapping[str, float]

    def reference(self, inliers: NDArray[np.bool_]) -> BareWall:
        """The bench as difference maps are formed from it; `inliers` (height, width) are the pixels of the plane."""
        return self.statistics.reference(inliers, serial=self.serial, settings=self.settings)

    def facts(self) -> dict[str, object]:
        """What a record says of the device."""
        told = {"serial": self.serial, "firmware": self.firmware}
        return {**told, "settings": dict(self.settings), "temperatures_c": self.statistics.celsius()}


def look(camera: Camera, frames: int, on_frame: Callable[[], None] = lambda: None) -> CaptureStatistics:
    """The statistics over at most `frames` frames of an entered camera. Raises WallRefusedError where none comes."""
    statistics, settings = BareWallStatistics(camera.intrinsics), dict[str, float]()
    for number, frame in enumerate(islice(camera, frames)):
        maps = maps_from_frame(frame)
        statistics.add(frame.depth_m, frame.ir, maps.depth_m, maps.intensity)
        settings = dict(frame.settings)
        if number % CELSIUS_EVERY == 0:
            statistics.look_at(camera.telemetry("_temperature"))
        on_frame()
    if statistics.depth.frames == 0:
        raise WallRefusedError(f"{camera.uri} gave no frames: record the wall again, or look at it live")
    serial, firmware = (camera.identity.get(name, "") for name in ("serial", "firmware"))
    return CaptureStatistics(camera.uri, statistics, camera.intrinsics, serial, firmware, settings)


NEAR_WALL_M = 0.02
"""Off the plane; what is farther away when the occluder stands is the occluder, or between both."""


def by_depth(seen: CaptureStatistics, tape_m: float | None = None) -> tuple[WallFit, dict[str, object]]:
    """The wall by its depth, and what the record says of the lidar's offset where a distance was measured by hand.

    Raises WallRefusedError, and CalibrationError where tape and lidar cannot both be right.
    """
    depth_m, noise = seen.statistics.depth.mean_m(), seen.statistics.depth.noise()

    def fit_with(offset_m: float, origin_m: float) -> WallFit:
        return fit_wall(depth_m + offset_m, seen.intrinsics, np.random.default_rng(0), noise, origin_m)

    if tape_m is None:
        return fit_with(0.0, 0.0), {}
    taped = fit_with_tape_distance(fit_with, tape_m)
    return taped.fit, {
        "range_offset_m": taped.offset_m,
        "range_offset_std_m": taped.offset_std_m,
        "range_offset_cause": taped.cause,
    }


def by_board(
    seen: CaptureStatistics, printed: Board, square_mm: float | None, colour: BoardView | None = None
) -> tuple[WallFit | WallByBoard, dict[str, object]]:
    """The wall by its depth, where that is not refused, and by a board, with what the record says of that.

    The board is looked for in the mean infrared, unless there is a `colour` view of it. Raises BoardRefusedError.
    """
    try:
        depth = by_depth(seen)[0]
    except WallRefusedError as error:
        depth = error
    measured = square_mm is not None
    board = printed.measured(square_mm) if measured else printed
    view = colour or BoardView(seen.statistics.ir_mean(), seen.intrinsics)
    fit, record = wall_with_board(depth, view, board, measured=measured)
    return fit, {"board": record}


def by_occluder(seen: CaptureStatistics, bare: MeasuredWall) -> tuple[WallRecord, NDArray[np.bool_]]:
    """The record of a bare wall with the occluder that stands before it now, and the wall's pixels beside that.

    Nothing may be hidden yet. Raises OccluderRefusedError, CalibrationError for another camera, and WallRefusedError
    where the lidar has moved since.
    """
    record, statistics = bare.record, seen.statistics.depth
    check_intrinsics(record.rig.pinhole, seen.intrinsics)
    if record.serial and seen.serial and record.serial != seen.serial:
        raise CalibrationError(
            f"the bare wall was measured with the camera {record.serial}, this is {seen.serial}: take that one, or "
            "calibrate the bare wall with this one"
        )
    offset_m = depth_lacks_m(record)
    depth_m, noise, pose = statistics.mean_m() + offset_m, statistics.noise(), wall_from_zero(record)
    surely = {"distance_std_m": record.distance_std_m or 0.0, "yaw_std_deg": record.yaw_std_deg or 0.0}
    found = find_occluder(depth_m, noise, seen.intrinsics, pose, np.random.default_rng(0), **surely)
    off_m = np.abs(points_m(record, depth_m - offset_m, seen.intrinsics)[..., 2])
    beside = np.where((off_m < NEAR_WALL_M) & ~found.pixels, depth_m, np.nan)
    origin_m = record.range_offset_m - offset_m
    wall = fit_wall(beside, seen.intrinsics, np.random.default_rng(0), noise, origin_m)
    _check_stands(record, wall)
    found = replace(found, x_std_m=hypot(found.x_std_m, _offset_moves_m(record, found)))
    changes = settings_changed(bare.reference, seen.settings) if bare.reference else ()
    notes = [f"settings have changed since the bare wall was measured: {', '.join(changes)}"] if changes else []
    return with_occluder(record, replace(found, warnings=(*found.warnings, *notes))), wall.inliers


def _offset_moves_m(record: WallRecord, found: OccluderFit) -> float:
    """The standard uncertainty that the range offset's gives the occluder's place; the gap has it by the distance's.

    An origin moves along the optical axis, and a depth along its ray; the wall, which turns with it, takes some back.
    """
    pose = np.array(record.wall_from_lidar)
    edge_m, axis = np.array([found.x_m, 0.0, found.gap_m]) - pose[:3, 3], pose[:3, 2]
    per_offset = edge_m[0] / (edge_m @ axis) if record.range_offset_cause == "depth" else axis[0]
    return abs(float(per_offset)) * (record.range_offset_std_m or 0.0)


def _check_stands(record: WallRecord, wall: WallFit) -> None:
    """Yaw and pitch each: on a wall faced obliquely, a lidar that nods faces it as before."""
    apart_m = wall.distance_m - record.distance_m
    yaw_deg, pitch_deg = wall.yaw_deg - record.yaw_deg, wall.pitch_deg - record.pitch_deg
    if max(abs(apart_m) / TOLERANCE_M, abs(yaw_deg) / TOLERANCE_DEG, abs(pitch_deg) / TOLERANCE_DEG) > 1.0:
        raise WallRefusedError(
            f"the lidar has moved since the bare wall was measured: the wall is {1e3 * abs(apart_m):.1f} mm "
            f"{'farther' if apart_m > 0 else 'nearer'}, the lidar turned by {yaw_deg:+z.2f} degrees in yaw and "
            f"{pitch_deg:+z.2f} in pitch: calibrate the bare wall again, then put the occluder back"
        )


GLANCE_COLUMNS = 160
"""A frame is thinned to about so many: a plane is still sure to a tenth of a millimetre."""


@dataclass(frozen=True)
class Glance:
    """What one frame says of the wall."""

    fit: WallFit | None
    refused: str
    """Why there is no fit; empty where there is one."""
    saturated: float
    """Share of the pixels whose IR is at its full scale."""


def glance(frame: Frame) -> Glance:
    """Fit the wall in one frame, thinned. The same frame gives the same glance."""
    depth_m, intrinsics = thinned(frame.depth_m, frame.intrinsics)
    saturated = saturated_share(frame.ir)
    try:
        fit = fit_wall(depth_m, intrinsics, np.random.default_rng(0))
    except WallRefusedError as error:
        return Glance(None, str(error), saturated)
    return Glance(fit, "", saturated)


def thinned(depth_m: Float32, intrinsics: Intrinsics) -> tuple[Float32, Intrinsics]:
    """Every n-th pixel of every n-th row, and the intrinsics that these have."""
    step = max(1, round(intrinsics.width / GLANCE_COLUMNS))
    first = step // 2
    few = depth_m[first::step, first::step]
    centre = (intrinsics.ppx - first) / step, (intrinsics.ppy - first) / step
    return few, Intrinsics(few.shape[1], few.shape[0], intrinsics.fx / step, intrinsics.fy / step, *centre)
