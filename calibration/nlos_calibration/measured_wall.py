"""A measured wall as it lies on disk: its record, and the reference of the bare wall beside it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.bare_wall import BareWall, load_reference
from nlos_calibration.wall_record import WallRecord, load_wall

Array = NDArray[np.float64]


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


def wall_points_m(record: WallRecord, reference: BareWall) -> Array:
    """The reference's pixels (height, width, 3) in the wall frame, NaN where no return: z is how far off the plane.

    The lidar's range offset is allowed for as it is in the record's pose.
    """
    of_depth_m = record.range_offset_m if record.range_offset_cause == "depth" else 0.0
    of_origin_m = record.range_offset_m if record.range_offset_cause == "origin" else 0.0
    pose = np.array(record.wall_from_lidar)
    points_m = (reference.depth_m[..., np.newaxis] + of_depth_m) * reference.intrinsics.rays()
    points_m[..., 2] += of_origin_m
    return points_m @ pose[:3, :3].T + pose[:3, 3]
