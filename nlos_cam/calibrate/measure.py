"""Measurement of a bench that stands still: statistics of a camera's frames, wall and occluder
fitted to them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import islice
from math import cos, hypot, isfinite, radians
from typing import Any

import nlos_calibration as walls
import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import CalibrationError, OccluderRefusedError, WallRefusedError
from numpy.typing import NDArray

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame, maps_from_frame, saturated_share
from nlos_cam.reconstruct import check_intrinsics, is_other_camera
from nlos_cam.recording import with_telemetry

CELSIUS_EVERY_S = 1.0
"""Time between temperature readings: each costs a command to the device."""
MAX_PARTS = 8
MIN_PART_FRAMES = 15
"""Number and length of the parts of a capture whose walls are compared: the lidar must stand still
from the first to the last."""


@dataclass(frozen=True)
class CaptureStatistics:
    """Statistics over the frames of a capture, with the device that took them."""

    camera: str
    """The URI."""
    statistics: walls.BareWallStatistics
    intrinsics: walls.Intrinsics
    serial: str
    firmware: str
    settings: Mapping[str, float]
    gravity_m_s2: walls.Gravity | None = None
    """By the accelerometer's last second; None without one."""
    parts_m: Sequence[Float64] = ()
    """Mean depth of each part of the capture, of `thinned` frames."""

    def reference(self, inliers: NDArray[np.bool_]) -> walls.BareWall:
        """Return the bench's reference for difference maps; `inliers` (height, width) are the
        pixels of the plane.
        """
        return self.statistics.reference(inliers, serial=self.serial, settings=self.settings)

    def facts(self) -> dict[str, object]:
        """Return the record's fields about the device."""
        return {
            "serial": self.serial,
            "firmware": self.firmware,
            "settings": dict(self.settings),
            "temperatures_c": self.statistics.celsius(),
            "gravity_m_s2": self.gravity_m_s2,
            "way_up": walls.way_up(self.gravity_m_s2),
        }

    def record(
        self,
        fit: walls.WallFit | walls.WallByBoard,
        facts: Mapping[str, object],
        occluder: walls.OccluderRecord | None = None,
    ) -> walls.WallRecord:
        """Return today's record of a wall; `facts` are further fields, as the measurements return
        them.
        """
        return walls.new_wall_record(
            fit,
            self.intrinsics,
            camera=self.camera,
            frames=self.statistics.depth.frames,
            created=datetime.now().astimezone().date(),
            occluder=occluder,
            others={**self.facts(), **facts},
        )


def collect_statistics(
    camera: Camera, frames: int, on_frame: Callable[[], None] = lambda: None
) -> CaptureStatistics:
    """Return the statistics of at most `frames` frames of an entered camera. Raises
    WallRefusedError without any.
    """
    statistics = walls.BareWallStatistics(camera.intrinsics)
    settings = dict[str, float]()
    gravity_m_s2: walls.Gravity | None = None
    parts: list[walls.DepthMean] = []
    part_frames = MIN_PART_FRAMES
    passing, telemetry = with_telemetry(camera, CELSIUS_EVERY_S)
    for number, frame in enumerate(islice(passing, frames)):
        maps = maps_from_frame(frame)
        statistics.add(frame.depth_m, frame.ir, maps.depth_m, maps.intensity)
        few_m, _ = thinned(frame.depth_m, frame.intrinsics)
        if number % part_frames == 0:
            # A recording may end long before the number of frames that were asked for: so parts are
            # short at first, and every second one goes as they become many.
            if len(parts) == MAX_PARTS:
                parts = parts[::2]
                part_frames *= 2
            parts.append(walls.DepthMean(*few_m.shape))
        parts[-1].add(few_m)
        settings = {name: value for name, value in frame.settings.items() if isfinite(value)}
        gravity_m_s2 = frame.gravity_m_s2 or gravity_m_s2
        if celsius := telemetry.at(frame):
            statistics.add_temperatures(celsius)
        on_frame()
    if statistics.depth.frames == 0:
        raise WallRefusedError(
            f"{camera.uri} gave no frames: record the wall again, or use a live camera"
        )
    serial = camera.identity.get("serial", "")
    firmware = camera.identity.get("firmware", "")
    return CaptureStatistics(
        camera.uri,
        statistics,
        camera.intrinsics,
        serial,
        firmware,
        settings,
        gravity_m_s2,
        tuple(part.mean_m() for part in parts),
    )


TURN_IT = (
    "and pictures would be too: turn it over, with the thread of its screw down and the object's"
    " side on the right of its view, or accept that with --upside-down"
)


def check_way_up(gravity_m_s2: walls.Gravity | None, said: walls.WayUp) -> walls.WayUp:
    """Return the way up of a camera: by gravity or, where that is not known, as its owner `said`.

    Raises CalibrationError for a camera that is not upright, unless the owner said so, and where
    gravity contradicts the owner.
    """
    found = walls.way_up(gravity_m_s2)
    if found == "unknown":
        return said
    if found == said or (found == "upright" and said == "unknown"):
        return found
    if found == "upright":
        raise CalibrationError("by gravity the camera is upright: leave out --upside-down")
    if found == "on its side":
        raise CalibrationError(
            "by gravity the camera is on its side, and the object's side must be on the right of"
            " its view: turn it upright, with the thread of its screw down"
        )
    raise CalibrationError(f"by gravity the camera is upside down, {TURN_IT}")


USUAL_OFFSET_M = 0.015
"""Range offset beyond which a tape is rather wrong than the lidar: an L515's is some millimetres."""
BESIDE_OCCLUDER_M = 0.06
"""Depth that a moved wall may be off its reference by; an occluder stands farther before it."""
NEAR_WALL_M = 0.02
"""Off the plane; with the occluder in place, pixels beyond are on the occluder or straddle its
edge.
"""


def measure_by_depth(
    capture: CaptureStatistics,
    tape_m: float | None = None,
    known: walls.WallRecord | None = None,
) -> tuple[walls.WallFit, dict[str, object]]:
    """Fit the wall to its depth; return the fit and the record's range-offset fields, by the
    distance by tape or else as an earlier record has `known` them.

    Raises WallRefusedError, also where the lidar moved meanwhile, and CalibrationError where tape
    and lidar cannot both be right.
    """
    _raise_if_disturbed(capture)
    if tape_m is None:
        return _fit_with_known_offset(capture, known) if known else (_fit_depth(capture, 0.0), {})

    def fit_along_rays(offset_m: float) -> walls.WallFit:
        # depth = range * cos(angle to the axis), and a ray of unit depth has the length 1 / cos
        length = np.linalg.norm(capture.intrinsics.rays(), axis=-1)
        return _fit_depth(capture, offset_m / length)

    taped = walls.fit_with_tape_distance(partial(_fit_depth, capture), tape_m, fit_along_rays)
    fit = taped.fit
    if taped.cause == "depth":
        _raise_if_disturbed(capture, offset_m=taped.offset_m)
    off_m = abs(taped.offset_m)
    if off_m > USUAL_OFFSET_M and fit.verdict != "doubtful":
        advice = (
            f"tape and lidar are {1e3 * off_m:.0f} mm apart, where an L515's beams start some"
            " millimetres beside its glass: measure the distance from the glass again"
        )
        fit = replace(fit, verdict="doubtful", advice=advice)
    return fit, _offset_fields(taped)


def _fit_with_known_offset(
    capture: CaptureStatistics, known: walls.WallRecord
) -> tuple[walls.WallFit, dict[str, object]]:
    """Fit the wall to its depth with a record's range offset, whose uncertainty makes the distance
    uncertain too; return the fit and the record's range-offset fields.
    """
    offset_m = walls.depth_offset_m(known)
    if offset_m:  # without one the capture was checked as it is
        _raise_if_disturbed(capture, offset_m=offset_m)
    fit = _fit_depth(capture, offset_m, known.range_offset_m - offset_m)
    # an origin that moves along the optical axis moves away from the wall by the cosine of that
    per_offset = cos(radians(fit.facing_deg))
    if known.range_offset_cause == "depth":
        per_offset = walls.distance_per_offset(fit, capture.intrinsics)
    std_m = hypot(fit.distance_std_m, per_offset * (known.range_offset_std_m or 0.0))
    names = ("range_offset_m", "range_offset_std_m", "range_offset_cause")
    return replace(fit, distance_std_m=std_m), {name: getattr(known, name) for name in names}


def _fit_depth(
    capture: CaptureStatistics, offset_m: float | NDArray[np.float64], origin_m: float = 0.0
) -> walls.WallFit:
    """Fit the wall to the mean depth with a length added, the pose's origin `origin_m` behind the
    zero of depth.
    """
    depth = capture.statistics.depth
    depth_m = depth.mean_m() + offset_m
    generator = np.random.default_rng(0)
    return walls.fit_wall(depth_m, capture.intrinsics, generator, depth.noise(), origin_m)


def _offset_fields(corrected: walls.CorrectedWall) -> dict[str, object]:
    """Return the record's fields of a range offset."""
    return {
        "range_offset_m": corrected.offset_m,
        "range_offset_std_m": corrected.offset_std_m,
        "range_offset_cause": corrected.cause,
    }


def measure_by_board(
    capture: CaptureStatistics,
    printed: walls.Board,
    square_mm: float | None,
) -> tuple[walls.WallFit | walls.WallByBoard, dict[str, object]]:
    """Fit the wall to its depth, unless that is refused, and to a printed board; return the fit and
    the record's fields of board and range offset.

    The board is searched in the mean infrared. Where its squares were measured (`square_mm`) and it
    contradicts the depth, a range offset that explains this is corrected. Raises BoardRefusedError,
    and WallRefusedError where the lidar moved meanwhile.
    """
    _raise_if_disturbed(capture)
    try:
        depth = _fit_depth(capture, 0.0)
    except WallRefusedError as error:
        depth = error
    measured = square_mm is not None
    board = printed.measured(square_mm) if measured else printed
    fit, record = walls.wall_with_board(
        depth, capture.statistics.ir_mean(), capture.intrinsics, board, measured=measured
    )
    if measured and record.used == "board":
        corrected = walls.fit_with_board_distance(
            partial(_fit_depth, capture), record.distance_m, record.distance_std_m
        )
        agreed = walls.with_range_offset(fit, depth, corrected) if corrected else None
        if corrected and agreed:
            _raise_if_disturbed(capture, offset_m=corrected.offset_m)
            if agreed.verdict != "doubtful":
                record = record.model_copy(update={"causes": ()})
            return agreed, {"board": record, **_offset_fields(corrected)}
    return fit, {"board": record}


def measure_occluder(
    capture: CaptureStatistics, bare: walls.MeasuredWall
) -> tuple[walls.WallRecord, NDArray[np.bool_]]:
    """Find the occluder in front of a known bare wall; return the record with it, and the wall's
    pixels beside it.

    No object may be hidden yet. Raises OccluderRefusedError, CalibrationError for another camera,
    and WallRefusedError if the lidar has moved since.
    """
    record = bare.record
    statistics = capture.statistics.depth
    check_intrinsics(bare, capture.intrinsics)
    if is_other_camera(record.serial, capture.serial):
        raise CalibrationError(
            f"the bare wall was measured with the camera {record.serial}, this is {capture.serial}:"
            " use that camera, or calibrate the bare wall with this one"
        )
    if turned := walls.turn_problem(capture.gravity_m_s2, record.gravity_m_s2, record.way_up):
        raise WallRefusedError(turned)
    offset_m = walls.depth_offset_m(record)
    depth_m = statistics.mean_m() + offset_m
    noise = statistics.noise()
    pose = walls.wall_from_zero(record)
    origin_m = record.range_offset_m - offset_m

    def fit_beside(wall_m: NDArray[np.float64]) -> walls.WallFit:
        generator = np.random.default_rng(0)
        return walls.fit_wall(wall_m, capture.intrinsics, generator, noise, origin_m)

    try:
        found = walls.find_occluder(
            depth_m,
            noise,
            capture.intrinsics,
            pose,
            np.random.default_rng(0),
            distance_std_m=record.distance_std_m,
            yaw_std_deg=record.yaw_std_deg,
        )
    except OccluderRefusedError:
        # a wall that is centimetres off its record would pass for an occluder, or hide behind it
        if bare.reference is not None:
            then_m, now_m = _in_common(bare.reference, offset_m, depth_m)
            near = np.abs(now_m - then_m) < BESIDE_OCCLUDER_M
            fits: list[walls.WallFit] = []
            with suppress(WallRefusedError):  # no wall to compare: the occluder's refusal says more
                fits = [fit_beside(np.where(near, each_m, np.nan)) for each_m in (then_m, now_m)]
            if fits:
                _raise_if_moved(*fits)
        raise
    # the wall is fitted again beside the occluder: if the lidar moved, the occluder's place would
    # be wrong as well
    off_m = np.abs(walls.points_m(record, depth_m - offset_m, capture.intrinsics)[..., 2])
    beside = np.where((off_m < NEAR_WALL_M) & ~found.pixels, depth_m, np.nan)
    wall = fit_beside(beside)
    _raise_if_disturbed(capture, np.isfinite(beside), offset_m)
    if bare.reference is None:
        _raise_if_moved(record, wall)
    else:
        then_m, now_m = _in_common(bare.reference, offset_m, beside)
        _raise_if_moved(fit_beside(then_m), fit_beside(now_m))
    found = replace(found, x_std_m=hypot(found.x_std_m, _edge_std_from_offset_m(record, found)))
    changes = walls.settings_changed(bare.reference, capture.settings) if bare.reference else ()
    if changes:
        note = f"settings have changed since the bare wall was measured: {', '.join(changes)}"
        found = replace(found, warnings=(*found.warnings, note))
    return walls.with_occluder(record, found), wall.inliers


def _edge_std_from_offset_m(record: walls.WallRecord, found: walls.OccluderFit) -> float:
    """Return the standard uncertainty in metres of the occluder's place along the wall due to the
    range offset's.

    An offset of the origin moves the edge along the optical axis z: dx = z_x per metre. An offset
    of depth stretches its ray p by 1 / (p . z): dx = p_x / (p . z). The wall turns with the lidar;
    the gap's share is in the distance's.
    """
    pose = np.array(record.wall_from_lidar)
    edge_m = np.array([found.x_m, 0.0, found.gap_m]) - pose[:3, 3]
    axis = pose[:3, 2]
    per_offset = edge_m[0] / (edge_m @ axis) if record.range_offset_cause == "depth" else axis[0]
    return abs(float(per_offset)) * (record.range_offset_std_m or 0.0)


def _in_common(
    reference: walls.BareWall, offset_m: float, beside_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the wall's depths (height, width) of the reference, with an offset added, and of now,
    in the pixels that both have.
    """
    # A range offset that is not corrected bends the depth's wall and turns it against the record's
    # pose, which may be a printed board's, and ripples do so otherwise in each part of the view.
    # The same pixels of the same lidar have the same errors, unless it has moved.
    then_m = reference.depth_m.astype(np.float64) + offset_m
    both = reference.inliers & np.isfinite(then_m) & np.isfinite(beside_m)
    return np.where(both, then_m, np.nan), np.where(both, beside_m, np.nan)


def _raise_if_moved(then: walls.WallRecord | walls.WallFit, wall: walls.WallFit) -> None:
    """Raise WallRefusedError if the lidar has moved since the bare wall was as `then`."""
    if moved := _how_moved(then, wall):
        raise WallRefusedError(
            f"the lidar has moved since the bare wall was measured: {moved}: calibrate the bare"
            " wall again, then put the occluder back"
        )


def _raise_if_disturbed(
    capture: CaptureStatistics,
    of_wall: NDArray[np.bool_] | None = None,
    offset_m: float = 0.0,
) -> None:
    """Raise WallRefusedError if the lidar moved while the capture was taken; `of_wall` (height,
    width) are the pixels of the wall where it does not fill the view.

    A part that is no wall tells nothing, as with a range offset: check again once that is known.
    """
    everywhere = np.ones((capture.intrinsics.height, capture.intrinsics.width), bool)
    seen, few = thinned(everywhere if of_wall is None else of_wall, capture.intrinsics)
    fits: list[walls.WallFit] = []
    for part_m in capture.parts_m:
        with suppress(WallRefusedError):
            wall_m = np.where(seen, part_m + offset_m, np.nan)
            fits.append(walls.fit_wall(wall_m, few, np.random.default_rng(0)))
    for later in fits[1:]:
        if moved := _how_moved(fits[0], later):
            raise WallRefusedError(
                f"the lidar moved while it measured the wall: {moved}: let it stand still, and"
                " measure again"
            )


def _how_moved(then: walls.WallRecord | walls.WallFit, wall: walls.WallFit) -> str:
    """Return in words how the lidar stands against a wall that was as `then`; empty within the
    tolerances.

    Yaw and pitch are compared, not the facing angle: on a wall faced obliquely, pitch hardly
    changes that.
    """
    apart_m = wall.distance_m - then.distance_m
    yaw_deg = wall.yaw_deg - then.yaw_deg
    pitch_deg = wall.pitch_deg - then.pitch_deg
    turn_deg = max(abs(yaw_deg), abs(pitch_deg))
    if abs(apart_m) <= walls.TOLERANCE_M and turn_deg <= walls.TOLERANCE_DEG:
        return ""
    return (
        f"the wall is {1e3 * abs(apart_m):.1f} mm {'farther' if apart_m > 0 else 'nearer'}, the"
        f" lidar turned by {yaw_deg:+z.2f} degrees in yaw and {pitch_deg:+z.2f} in pitch"
    )


MAX_FIT_COLUMNS = 160
"""A single frame is thinned to about this width: the plane is still known to a tenth of a
millimetre.
"""


@dataclass(frozen=True)
class FrameFit:
    """Wall fitted to one frame, for somebody who is positioning the lidar."""

    fit: walls.WallFit | None
    refusal: str
    """Why there is no fit; empty where there is one."""
    saturated: float
    """Share of the pixels whose IR is at its full scale."""


def fit_frame(frame: Frame) -> FrameFit:
    """Fit the wall to one thinned frame; deterministic."""
    depth_m, intrinsics = thinned(frame.depth_m, frame.intrinsics)
    saturated = saturated_share(frame.ir)
    try:
        return FrameFit(
            walls.fit_wall(depth_m, intrinsics, np.random.default_rng(0)), "", saturated
        )
    except WallRefusedError as error:
        return FrameFit(None, str(error), saturated)


def thinned(
    image: NDArray[Any], intrinsics: walls.Intrinsics
) -> tuple[NDArray[Any], walls.Intrinsics]:
    """Return every n-th pixel of every n-th row of an image, and their intrinsics."""
    step = max(1, round(intrinsics.width / MAX_FIT_COLUMNS))
    first = step // 2
    few = image[first::step, first::step]
    center = (intrinsics.ppx - first) / step, (intrinsics.ppy - first) / step
    return few, walls.Intrinsics(
        few.shape[1], few.shape[0], intrinsics.fx / step, intrinsics.fy / step, *center
    )
