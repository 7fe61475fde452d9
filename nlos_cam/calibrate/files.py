"""Files that `calibrate` writes: the record, the bare wall's reference and the report."""

import os
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from nlos_calibration import BareWall, MeasuredWall, WallRecord, dump_toml, save_reference

from nlos_cam.bench import MAIN, StationRecord, edit_bench, station_folder
from nlos_cam.calibrate.report import report_html
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import atomic_file


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

    They replace earlier ones only when all are complete, so an interrupted run leaves the earlier
    set whole.
    """
    with ExitStack() as parts:
        record_part = parts.enter_context(atomic_file(files.record))
        if reference is not None:
            digest = save_reference(parts.enter_context(atomic_file(files.reference)), reference)
            record = record.model_copy(
                update={"reference": files.reference.name, "reference_sha256": digest}
            )
        html = report_html(MeasuredWall(record, reference), files.record.name)
        parts.enter_context(atomic_file(files.report)).write_text(html, encoding="utf-8")
        record_part.write_text(dump_toml(record), encoding="utf-8")
    return record


def files_in_bench(
    folder: Path, *, occluder: bool, overwrite: bool, station: str = MAIN
) -> WallFiles:
    """Return the paths of a measurement in a bench folder: of the bare wall, or with its occluder.

    Raises OutputExistsError for an existing file without `overwrite`.
    """
    record = folder / station_folder(station) / ("occluder.toml" if occluder else "wall.toml")
    if record.exists() and not overwrite:
        raise OutputExistsError(
            f"{record} exists: choose another bench, or add --overwrite to replace it"
        )
    return WallFiles.beside(record, overwrite=overwrite)


def write_to_bench(
    folder: Path,
    files: WallFiles,
    record: WallRecord,
    reference: BareWall | None,
    station: str = MAIN,
) -> WallRecord:
    """Write a measurement to its `files_in_bench` and enter it in the bench, which is made if it is
    missing; return the record, which names its reference.

    A wall that is measured again drops the occluder found before; the object box stays.
    """
    with edit_bench(folder) as edit:
        files.record.parent.mkdir(parents=True, exist_ok=True)
        record = write_record(files, record, reference)
        name = files.record.relative_to(folder).as_posix()
        before = edit.stations.get(station)
        box = before.object_box if before else record.rig.object_box
        if files.record.stem == "occluder" and before:
            entry = StationRecord(wall=before.wall, occluder=name, object_box=box)
        else:
            entry = StationRecord(wall=name, object_box=box)
        edit.set_station(station, entry, record)
        edit.add(files.record, *([files.reference] if reference else []))
    return record
