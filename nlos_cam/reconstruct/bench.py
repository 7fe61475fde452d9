"""What a streaming loop knows of its bench: the rig, the bare wall that difference maps are formed from, its drift."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from nlos_calibration import (
    BareWall,
    DriftCheck,
    Intrinsics,
    MeasuredWall,
    Rig,
    WallRecord,
    load_measured,
    load_rig,
    wall_from_zero,
)
from nlos_calibration.errors import CalibrationError

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame, LidarMaps

MAX_INTRINSICS_MISMATCH_PX = 0.25
"""By which a beam of the camera may miss the pixel that it was measured at: 0.14 mm of depth at 0.25 m, 45 degrees."""


@dataclass(frozen=True)
class BenchObservation:
    """What the bench makes of a frame."""

    difference: LidarMaps | None
    """The maps less the bare wall's, valid where both are; None without a reference."""
    warnings: tuple[str, ...]
    moved: bool = False
    """Whether the lidar has moved, or no longer sees the wall where it was."""


class CalibratedRig:
    """A rig and, where the wall was measured, what is known of it. One thread looks at frames, in their order."""

    def __init__(self, rig: Rig, measured: MeasuredWall | None = None, notes: tuple[str, ...] = ()) -> None:
        self.rig, self.measured = rig, measured
        self.notes = notes
        """Warnings that hold whatever the frames say."""
        self.reference: BareWall | None = measured.reference if measured else None
        self._drift: DriftCheck | None = None
        if measured and measured.reference:
            self._drift = DriftCheck(measured.reference, wall_from_zero(measured.record))

    def look_at(self, celsius: Mapping[str, float]) -> None:
        """Take one reading of the device's temperatures in."""
        if self._drift:
            self._drift.look_at(celsius)

    def look(self, frame: Frame, maps: LidarMaps) -> BenchObservation:
        """The difference of the maps, which need not be of this frame alone, and what has drifted up to this frame."""
        if self.reference is None or self._drift is None:
            return BenchObservation(None, self.notes)
        self._drift.look(frame.depth_m, frame.settings)
        difference = self._levelled(difference_of(maps, self.reference))
        return BenchObservation(difference, self.notes + self._drift.warnings, self._drift.moved)

    def _levelled(self, difference: LidarMaps) -> LidarMaps:
        """The difference less what the range has drifted by over the last second, if it has drifted alike everywhere.

        That is most of what a change of temperature leaves (docs/calibration-measured.md).
        """
        drift = self._drift.drift if self._drift else None
        if drift is None or not drift.uniform:
            return difference
        return replace(difference, depth_m=difference.depth_m - np.float32(drift.range_m))

    def corrected(self, maps: LidarMaps) -> LidarMaps:
        """The maps with what the lidar's depth lacks, where that was measured (`range_offset`)."""
        offset_m = self.measured.record.range_offset_m if self.measured else 0.0
        return replace(maps, depth_m=maps.depth_m + np.float32(offset_m)) if offset_m else maps


def difference_of(maps: LidarMaps, reference: BareWall) -> LidarMaps:
    """The maps less those of the bare wall."""
    depth_m = maps.depth_m - reference.map_depth_m
    valid = ~np.isnan(depth_m)
    return LidarMaps(depth_m, np.where(valid, maps.intensity - reference.map_intensity, np.float32(0.0)), valid)


def open_bench(wall: Path | None, camera: Camera) -> CalibratedRig:
    """The bench of a wall record, else the camera's own where that can hide something, else the paper's.

    Raises RecordFileError, and CalibrationError where the record is of a wall that another camera sees.
    """
    if wall is None:
        return CalibratedRig(camera.rig if camera.rig and camera.rig.object_box else load_rig("paper-rig"))
    measured = load_measured(wall)
    known = [measured.record.rig.pinhole, *([measured.reference.intrinsics] if measured.reference else [])]
    for intrinsics in known:
        check_intrinsics(intrinsics, camera.intrinsics)
    return CalibratedRig(measured.record.rig, measured, _notes(measured.record, camera))


def check_intrinsics(measured: Intrinsics, given: Intrinsics) -> None:
    """Raise CalibrationError where a camera's pixels are not those that a wall was measured with."""
    of_wall, of_camera = (f"{size.width}x{size.height}" for size in (measured, given))
    if of_wall != of_camera:
        raise CalibrationError(
            f"the wall was measured at {of_wall}, the camera gives {of_camera}: plug it in as it was then (USB 2 "
            "halves the size), or calibrate the wall again"
        )
    apart = _apart_pixels(measured, given)
    if not apart <= MAX_INTRINSICS_MISMATCH_PX:  # NaN is not
        raise CalibrationError(
            f"the wall was measured with other intrinsics (fx {measured.fx:.2f}, ppx {measured.ppx:.2f}) than the "
            f"camera's (fx {given.fx:.2f}, ppx {given.ppx:.2f}), {apart:.1f} pixels apart: calibrate the wall with "
            "this camera"
        )


def _apart_pixels(one: Intrinsics, other: Intrinsics) -> float:
    """The most by which a beam falls on different pixels, along an axis; it is at an edge of the view."""
    along_x = [other.ppx + (x - one.ppx) * other.fx / one.fx - x for x in (-0.5, one.width - 0.5)]
    along_y = [other.ppy + (y - one.ppy) * other.fy / one.fy - y for y in (-0.5, one.height - 0.5)]
    return max(abs(apart) for apart in along_x + along_y)


def _notes(record: WallRecord, camera: Camera) -> tuple[str, ...]:
    serial = camera.identity.get("serial", "")
    if not serial or not record.serial or serial == record.serial:
        return ()
    return (
        f"the wall was measured with the camera {record.serial}, this is {serial}: calibrate the wall with this one",
    )
