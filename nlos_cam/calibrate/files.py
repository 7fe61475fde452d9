"""Files that `calibrate` writes: the record, the bare wall's reference and the report."""

import os
from dataclasses import dataclass
from pathlib import Path

from nlos_calibration import BareWall, MeasuredWall, WallRecord, dump_toml, save_reference

from nlos_cam.calibrate.report import report_html
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import atomic_files


@dataclass(frozen=True)
class WallFiles:
    """Paths of the three files, which differ in their suffix only."""

    record: Path
    reference: Path
    report: Path

    @classmethod
    def beside(cls, record: Path, *, overwrite: bool) -> "WallFiles":
        """Return the paths for a record. Raises OutputExistsError for an existing file without
        `overwrite`.
        """
        files = cls(record, record.with_suffix(".npz"), record.with_suffix(".html"))
        if record in (files.reference, files.report):
            raise OutputExistsError(
                f"{record} would be overwritten by the reference or the report: name it wall.toml"
            )
        for path in (files.reference, files.report):
            if path.is_dir() or (os.path.lexists(path) and not overwrite):
                raise OutputExistsError(
                    f"{path} exists: choose another name, or add --overwrite to replace it"
                )
        return files


def write_record(files: WallFiles, record: WallRecord, reference: BareWall | None) -> WallRecord:
    """Write the three files and return the record, which names its reference.

    They take the places of earlier ones together, when all are on the disk. A power cut between two
    of the renames leaves a record that `load_measured` refuses, since its reference is another.
    """
    paths = [files.record, files.report, *([files.reference] if reference is not None else [])]
    with atomic_files(*paths) as (record_part, report_part, *reference_part):
        if reference is not None:
            digest = save_reference(reference_part[0], reference)
            record = record.model_copy(
                update={"reference": files.reference.name, "reference_sha256": digest}
            )
        html = report_html(MeasuredWall(record, reference), files.record.name)
        record_part.write_text(dump_toml(record), encoding="utf-8")
        report_part.write_text(html, encoding="utf-8")
    return record
