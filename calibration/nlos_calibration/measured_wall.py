"""A measured wall as it lies on disk: its record, and the reference of the bare wall beside it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlos_calibration.arrays import Float64
from nlos_calibration.bare_wall import BareWall, load_reference
from nlos_calibration.projection import Intrinsics
from nlos_calibration.wall_record import WallRecord, load_wall


@dataclass(frozen=True)
class MeasuredWall:
    """What `calibrate --wall` left behind."""

    record: WallRecord
    reference: BareWall | None
    """None for a record that names none."""


def load_measured(path: Path) -> MeasuredWall:
    """Read a `wall.toml` and the reference beside it.

    Raises RecordFileError where one of them cannot be read, or where they do not belong together.
    """
    record = load_wall(path)
    named = record.reference
    return MeasuredWall(record, load_reference(path.parent / named, record.reference_sha256) if named else None)


def wall_points_m(record: WallRecord, reference: BareWall) -> Float64:
    """The reference's pixels (height, width, 3) in the wall frame, NaN where no return: z is how far off the plane."""
    return points_m(record, reference.depth_m.astype(np.float64), reference.intrinsics)


def points_m(record: WallRecord, depth_m: Float64, intrinsics: Intrinsics) -> Float64:
    """Depths (height, width) of the lidar as points (height, width, 3) in the wall frame.

    The lidar's range offset is allowed for as it is in the record's pose.
    """
    pose = wall_from_zero(record)
    return ((depth_m[..., np.newaxis] + depth_lacks_m(record)) * intrinsics.rays()) @ pose[:3, :3].T + pose[:3, 3]


def depth_lacks_m(record: WallRecord) -> float:
    """What is to be added to each depth before it is a point: the range offset, where depth is its cause."""
    return record.range_offset_m if record.range_offset_cause == "depth" else 0.0


def wall_from_zero(record: WallRecord) -> Float64:
    """The pose (4, 4) of where the beams meet: the lidar's, but that an offset of the origin is before the glass."""
    pose = np.array(record.wall_from_lidar)
    pose[:3, 3] += (record.range_offset_m - depth_lacks_m(record)) * pose[:3, 2]
    return pose
