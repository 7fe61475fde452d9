"""Bench folders made up in a moment, from `measured_walls.exact_wall`."""

from pathlib import Path
from typing import Any

import pytest
from measured_walls import exact_wall
from nlos_calibration import MeasuredWall, OccluderRecord

from nlos_cam.cli.benches import files_in_bench, write_to_bench

SERIAL = "f0123456"
OCCLUDER = OccluderRecord(source="detected", x_m=0.2, gap_m=0.1)


def wall_of(*, occluder: bool = False, serial: str = SERIAL, **changes: Any) -> MeasuredWall:
    """A measured wall of a camera; `changes` are fields of its record."""
    measured = exact_wall()
    fields = {"serial": serial, "occluder": OCCLUDER if occluder else None, **changes}
    return MeasuredWall(measured.record.model_copy(update=fields), measured.reference)


def write_wall(folder: Path, measured: MeasuredWall, *, overwrite: bool = False) -> None:
    """Write a measurement into a bench folder, as `calibrate` does."""
    occluder = measured.record.occluder is not None
    files = files_in_bench(folder, occluder=occluder, overwrite=overwrite)
    write_to_bench(folder, files, measured.record, measured.reference, overwrite=overwrite)


def _no_report(*_: object) -> str:
    return "report"


def make_bench(folder: Path, **changes: Any) -> Path:
    """A bench of a bare wall, then of its occluder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nlos_cam.calibrate.files.report_html", _no_report)
        write_wall(folder, wall_of(**changes))
        write_wall(folder, wall_of(occluder=True, **changes))
    return folder
