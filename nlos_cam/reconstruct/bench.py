"""Rig of a bench with its measured bare wall: difference maps, drift, range offset."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import nlos_calibration as walls
import numpy as np
from nlos_calibration.errors import CalibrationError

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame, LidarMaps

MAX_INTRINSICS_MISMATCH_PX = 0.25
"""Largest distance between a beam's pixels in two calibrations: 0.14 mm of depth at 0.25 m and 45
degrees.
"""
NOT_MEASURED = (
    "no wall was measured, so the paper's rig is assumed: calibrate the bench, or name it (--bench)"
)


@dataclass(frozen=True)
class BenchObservation:
    """Difference maps and state of the bench at one frame."""

    difference: LidarMaps | None
    """Maps less those of the bare wall, valid where both are; None without a reference."""
    warnings: tuple[str, ...]
    moved: bool = False
    """The lidar has moved or was turned, or something hides the wall from it."""
    drift_m: float = 0.0
    """Range drift since the wall was measured, over the last second, if all depths have drifted
    alike; else 0.
    """


class CalibratedRig:
    """Rig and, if the wall was measured, its record, reference and drift.

    Stateful (drift): `observe` the frames in order, from one thread.
    """

    def __init__(
        self,
        rig: walls.Rig,
        measured: walls.MeasuredWall | None = None,
        notes: tuple[str, ...] = (),
    ) -> None:
        self.rig = rig
        self.measured = measured
        self.notes = notes
        """Warnings about how the bench was set up."""
        self.reference: walls.BareWall | None = measured.reference if measured else None
        self._drift: walls.DriftCheck | None = None
        if measured and measured.reference:
            self._drift = walls.DriftCheck(
                measured.reference, walls.wall_from_zero(measured.record)
            )

    def afresh(self) -> "CalibratedRig":
        """Return the same bench, of which no frame has been observed."""
        return CalibratedRig(self.rig, self.measured, self.notes)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings that hold for every frame: the notes, a record that calls itself doubtful, and
        one of a camera that is upside down.
        """
        notes = list(self.notes)
        record = self.measured.record if self.measured else None
        if record and record.verdict == "doubtful":
            notes.append(f"the wall's record calls itself doubtful: {record.advice}")
        if record and record.way_up not in {"upright", "unknown"}:
            notes.append(f"the camera is {record.way_up}, as its record says: so are the pictures")
        return tuple(notes)

    def update_temperatures(self, celsius: Mapping[str, float]) -> None:
        """Pass one reading of the device's temperatures to the drift check."""
        if self._drift:
            self._drift.update_temperatures(celsius)

    def observe(self, frame: Frame, maps: LidarMaps) -> BenchObservation:
        """Return the difference of the maps, which may be a mean over frames, and the drift up to
        this frame.
        """
        turned = self.turn_problem(frame)
        warnings = (*self.warnings, turned) if turned else self.warnings
        if self.reference is None or self._drift is None:
            return BenchObservation(None, warnings, bool(turned))
        drift_m = self.follow(frame)
        difference = subtract_reference(maps, self.reference)
        difference = replace(difference, depth_m=difference.depth_m - np.float32(drift_m))
        moved = self.moved or bool(turned)
        return BenchObservation(difference, warnings + self._drift.warnings, moved, drift_m)

    def follow(self, frame: Frame) -> float:
        """Pass a frame to the drift check, and return the range's drift over the last second in
        metres; 0 where not all depths have drifted alike, or it is not known.

        Without it most of the effect of a change of temperature is gone
        (docs/calibration-measured.md).
        """
        if self._drift is None:
            return 0.0
        self._drift.observe(frame.depth_m, frame.settings)
        drift = self._drift.drift
        return drift.range_m if drift and drift.uniform else 0.0

    @property
    def moved(self) -> bool:
        """Whether the frames that were followed show that the lidar has moved, or no wall."""
        return self._drift is not None and self._drift.moved

    def turn_problem(self, frame: Frame) -> str:
        """Return in one line how the lidar was turned since its wall was measured, by gravity;
        empty where it was not, or has no accelerometer.
        """
        if self.measured is None:
            return walls.turn_problem(frame.gravity_m_s2)
        record = self.measured.record
        return walls.turn_problem(frame.gravity_m_s2, record.gravity_m_s2, record.way_up)

    def correct_range(self, maps: LidarMaps, drift_m: float = 0.0) -> LidarMaps:
        """Return the maps with the measured offset of the lidar's depth added, if there is one,
        less the drift since.
        """
        added_m = self.range_offset_m - drift_m
        if not added_m:
            return maps
        return replace(maps, depth_m=maps.depth_m + np.float32(added_m))

    @property
    def range_offset_m(self) -> float:
        """Range offset of the lidar's depth as it was measured; 0 if it was not, or is the
        origin's, which is in the rig (`WallRecord.beam_rig`).
        """
        return walls.depth_offset_m(self.measured.record) if self.measured else 0.0


def subtract_reference(maps: LidarMaps, reference: walls.BareWall) -> LidarMaps:
    """Return the maps less those of the bare wall; intensity 0 where either has no depth."""
    depth_m = maps.depth_m - reference.map_depth_m
    valid = ~np.isnan(depth_m)
    return LidarMaps(
        depth_m, np.where(valid, maps.intensity - reference.map_intensity, np.float32(0.0)), valid
    )


def open_bench(wall: Path | None, camera: Camera) -> CalibratedRig:
    """Return the bench of a wall record; without one, the camera's own if it has an object box,
    else the paper's.

    Raises RecordFileError, and CalibrationError if the wall was measured with other intrinsics.
    """
    if wall is None:
        if camera.rig and camera.rig.object_box:
            return CalibratedRig(camera.rig)
        return CalibratedRig(walls.load_rig("paper-rig"), notes=(NOT_MEASURED,))
    measured = walls.load_measured(wall)
    check_intrinsics(measured, camera.intrinsics)
    serial = camera.identity.get("serial", "")
    notes: list[str] = []
    if is_other_camera(measured.record.serial, serial):
        notes.append(
            f"the wall was measured with camera {measured.record.serial}, this is {serial}:"
            " calibrate the wall with this one"
        )
    if measured.record.occluder is None:
        notes.append(occluder_assumed(wall))
    return CalibratedRig(measured.record.beam_rig, measured, tuple(notes))


def occluder_assumed(place: Path) -> str:
    """Return the note on a bench whose occluder has not been measured, by its record or folder."""
    return (
        "the occluder has not been measured, the paper's is assumed: put it up and run `nlos-cam"
        f" calibrate --occluder {shlex.quote(str(place))}`"
    )


def is_other_camera(measured: str, given: str) -> bool:
    """Return whether two serial numbers are of two cameras; an empty one is not known."""
    return bool(measured and given) and measured != given


def check_intrinsics(measured: walls.MeasuredWall, given: walls.Intrinsics) -> None:
    """Raise CalibrationError if a camera's intrinsics `given` are not those that the wall and its
    reference were measured with.
    """
    _check_intrinsics(measured.record.rig.pinhole, given)
    if measured.reference:
        _check_intrinsics(measured.reference.intrinsics, given)


def _check_intrinsics(measured: walls.Intrinsics, given: walls.Intrinsics) -> None:
    if (measured.width, measured.height) != (given.width, given.height):
        raise CalibrationError(
            f"the wall was measured at {measured.width}x{measured.height}, the camera delivers"
            f" {given.width}x{given.height}: use the same USB port and cable (USB 2 halves the"
            " size), or calibrate the wall again"
        )
    mismatch = _mismatch_pixels(measured, given)
    if not mismatch <= MAX_INTRINSICS_MISMATCH_PX:  # NaN compares false
        raise CalibrationError(
            f"the wall was measured with other intrinsics (fx {measured.fx:.2f}, ppx"
            f" {measured.ppx:.2f}) than the camera's (fx {given.fx:.2f}, ppx {given.ppx:.2f}),"
            f" {mismatch:.1f} pixels apart: calibrate the wall with this camera"
        )


def _mismatch_pixels(one: walls.Intrinsics, other: walls.Intrinsics) -> float:
    """Return the largest distance, along x or y, between a beam's pixels in the two.

    Pixel x of `one` is the beam (x - ppx) / fx, hence pixel ppx' + (x - ppx) fx' / fx of the other:
    linear in x, so the largest distance is at an edge of the view.
    """
    along_x = [other.ppx + (x - one.ppx) * other.fx / one.fx - x for x in (-0.5, one.width - 0.5)]
    along_y = [other.ppy + (y - one.ppy) * other.fy / one.fy - y for y in (-0.5, one.height - 0.5)]
    return max(abs(pixels) for pixels in along_x + along_y)
