"""A measured wall as it lies on disk: its record, and the reference of the bare wall beside it."""

from dataclasses import dataclass
from pathlib import Path

from nlos_calibration.bare_wall import BareWall, load_reference
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
