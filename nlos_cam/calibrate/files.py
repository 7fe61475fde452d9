"""What `calibrate` leaves on disk: the record, the bare wall's reference beside it, and a report."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from nlos_calibration import BareWall, MeasuredWall, WallRecord, dump_toml, save_reference

from nlos_cam.calibrate.report import report
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import atomic_file


@dataclass(frozen=True)
class WallFiles:
    """Three files of one name."""

    record: Path
    reference: Path
    report: Path

    @classmethod
    def beside(cls, record: Path, *, overwrite: bool) -> "WallFiles":
        """Those of a record. Raises OutputExistsError where one would be replaced and `overwrite` was not given."""
        files = cls(record, record.with_suffix(".npz"), record.with_suffix(".html"))
        if record in (files.reference, files.report):
            raise OutputExistsError(f"{record} would be overwritten by what is written beside it: name it wall.toml")
        for path in (files.reference, files.report):
            if path.is_dir() or (path.exists() and not overwrite):
                raise OutputExistsError(f"{path} exists: choose another name, or add --overwrite to replace it")
        return files


def written(files: WallFiles, record: WallRecord, reference: BareWall | None) -> WallRecord:
    """Write all there is; returns the record, which names its reference.

    Each is whole before one takes its place, so that what ends this early leaves earlier ones that belong together.
    """
    with ExitStack() as whole:
        part = whole.enter_context(atomic_file(files.record))
        if reference is not None:
            digest = save_reference(whole.enter_context(atomic_file(files.reference)), reference)
            record = record.model_copy(update={"reference": files.reference.name, "reference_sha256": digest})
        told = whole.enter_context(atomic_file(files.report))
        told.write_text(report(MeasuredWall(record, reference), files.record.name), encoding="utf-8")
        part.write_text(dump_toml(record), encoding="utf-8")
    return record
