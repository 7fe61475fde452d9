"""The options --bench, a bench folder in place of --wall, --weights and --rig, and --weights."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import nlos_calibration as walls
import typer
from nlos_calibration.errors import UnknownRigError

from nlos_cam import bench as benches
from nlos_cam import calibrate, reconstruct
from nlos_cam import camera as cameras
from nlos_cam import recording as recordings
from nlos_cam.cli import common
from nlos_cam.errors import OutputExistsError

if TYPE_CHECKING:
    from nlos_cam.forecast import Forecast

BenchFolder = Annotated[
    Path | None,
    typer.Option("--bench", help="Bench folder of `calibrate --bench`, in place of --wall."),
]
Weights = Annotated[
    Path | None,
    typer.Option(
        "--weights",
        help=(
            "Folder of weights, or direct, wide, any, paper (default: of the first three those that"
            " serve the rig best)."
        ),
    ),
]
BenchOrWeights = Annotated[
    Path | None,
    typer.Option(
        "--bench", help="Bench folder of `calibrate --bench`, in place of --wall and --weights."
    ),
]
BenchOrRig = Annotated[
    Path | None,
    typer.Option("--bench", help="Bench folder of `calibrate --bench`, in place of --rig."),
]


FOLDER_ENDS = tuple(filter(None, (os.sep, os.altsep)))
"""Ends of a path that can only be a folder's, also where there is none."""


class Choice(NamedTuple):
    """Bench, wall record and weights that a command was given."""

    bench: benches.Bench | None
    record: Path | None
    """Wall record, of the bench or on its own."""
    weights: Path | None
    """Folder of weights: those named, else the bench's own; None for the shipped ones."""

    def open(self, camera: cameras.Camera) -> reconstruct.CalibratedRig:
        """Return the rig for an opened camera. Raises CalibrationError where they do not fit."""
        if self.bench:
            return self.bench.for_camera(camera)
        if self.record is None:
            _note_recorded_wall(camera.uri)
        return reconstruct.open_bench(self.record, camera)

    @property
    def recorded_wall(self) -> tuple[walls.Rig, recordings.WallFile] | None:
        """Rig and measured wall as sidecars of recordings name them; None without a record."""
        if self.record is None:
            return None
        rig, file = recordings.load_measured_wall(self.record)
        return (self.bench.rig if self.bench else rig), file

    def load_networks(self, bench: reconstruct.CalibratedRig) -> benches.ServingNetworks:
        """Load the weights, or the shipped ones that serve a rig best, and print their name and
        their mismatches with the bench. Raises CheckpointError.
        """
        found = benches.load_serving(bench, self.weights, self.bench, self.record)
        rig = reconstruct.rig_in_words(found.network.record)
        common.say(f"Loaded weights {found.weights}, for {rig} ({found.network.runtime})")
        if not found.verdict.is_warning:
            sentence = found.verdict.sentence
            common.say(sentence[:1].upper() + sentence[1:])
        for mismatch in found.mismatches:
            common.say(f"note: {mismatch}")
        return found


def choose(
    bench: Path | None,
    wall: Path | None = None,
    weights: Path | None = None,
    *,
    reconstructs: bool = True,
) -> Choice:
    """Load the bench folder, if there is one; its own weights only where it `reconstructs`, by no
    others. Raises RecordFileError, and typer.BadParameter for a bench and a wall record.
    """
    if bench is None:
        return Choice(None, wall, weights)
    if wall is not None:
        raise typer.BadParameter("--bench and --wall each name a measured wall: give one")
    loaded = benches.load_bench(bench, weights=reconstructs and weights is None)
    return Choice(loaded, loaded.wall, weights or loaded.weights)


def rig_of(bench: Path | None, rig: str | None) -> walls.Rig | None:
    """Return the rig of a bench folder, or of a name or file; None without either. Raises
    typer.BadParameter for both.
    """
    return rig_or_default(bench, rig, common.PAPER_RIG) if bench or rig else None


def rig_or_default(bench: Path | None, rig: str | None, default: str) -> walls.Rig:
    """Return the rig of a bench folder, of a name or file, or the default's. Raises
    typer.BadParameter for both.
    """
    if bench is not None and rig is not None:
        raise typer.BadParameter("--bench and --rig each name a rig: give one")
    if bench is not None:
        loaded = benches.load_bench(bench, weights=False)
        note_warnings(loaded.calibrated)
        return loaded.rig
    name = rig or default
    found = walls.rig_named(name)
    if walls.is_wall_record(name):
        _note_doubt(name, walls.load_wall(Path(name)))
    return found


def _note_recorded_wall(uri: str) -> None:
    """Print on which measured wall a recording was made, where the command names none."""
    scheme, _, path = uri.partition(":")
    wall = recordings.recorded_wall(Path(path)) if scheme == "bag" else None
    if wall:
        common.say(
            f"note: {path} was recorded on the wall of {wall.path}: name its bench (--bench) or"
            " this record (--wall)"
        )


def note_warnings(bench: reconstruct.CalibratedRig) -> None:
    """Print the warnings about a bench that hold for every frame."""
    for warning in bench.warnings:
        common.say(f"note: {warning}")


def _note_doubt(name: str, record: walls.WallRecord) -> None:
    """Print that a wall record is doubtful by its own verdict, or of a bare wall."""
    if record.verdict == "doubtful":
        common.say(f"note: {name} calls itself doubtful: {record.advice}")
    if record.occluder is None:
        common.say(f"note: {reconstruct.occluder_assumed(Path(name))}")


def names_folder(name: str) -> bool:
    """Return whether a name is that of a bench folder, and not of a packaged rig beside a folder
    that happens to be called like it.
    """
    if name.endswith(FOLDER_ENDS):
        return True
    packaged = {path.stem for path in walls.packaged_rigs()}
    return benches.is_bench(Path(name)) if name in packaged else Path(name).is_dir()


def bench_or_rig(name: str | Path) -> tuple[walls.Rig, walls.MeasuredWall | None]:
    """Return the rig of a bench folder, a wall record, a rig's file or a packaged rig and, where it
    was measured, its wall; print what is doubtful about it.
    """
    name = str(name)
    if names_folder(name):
        loaded = benches.load_bench(name, weights=False)
        note_warnings(loaded.calibrated)
        return loaded.rig, loaded.measured
    if walls.is_wall_record(name):
        measured = walls.load_measured(Path(name))
    else:
        return _rig_named(name), None
    _note_doubt(name, measured.record)
    return measured.record.beam_rig, measured


def _rig_named(name: str) -> walls.Rig:
    try:
        return walls.rig_named(name)
    except UnknownRigError as error:
        raise UnknownRigError(f"{error} or a bench folder") from error


def store_forecast(folder: Path) -> None:
    """Forecast what a bench with an occluder shows, and enter it in its record: takes seconds.

    Raises RecordFileError.
    """
    bench = benches.load_bench(folder, weights=False)
    if not bench.can_be_forecast:
        return
    from nlos_cam.forecast import forecast  # not for `live`

    common.say("Forecasting what this bench can show")
    keep_forecast(bench, forecast(bench.rig, quick=True))


def keep_forecast(bench: benches.Bench, found: Forecast) -> None:
    """Enter a forecast in a bench's record."""
    with benches.edit_bench(bench.folder) as edit:
        edit.set_forecast(bench.station, benches.ForecastRecord.of(found))


def files_in_bench(folder: Path, *, occluder: bool, overwrite: bool) -> calibrate.WallFiles:
    """Return the paths of a measurement in a bench folder: of the bare wall, or with its occluder.

    Raises OutputExistsError for an existing file without `overwrite`.
    """
    name = "occluder.toml" if occluder else "wall.toml"
    record = folder / benches.station_folder(benches.MAIN) / name
    _refuse_existing(record, overwrite=overwrite)
    return calibrate.WallFiles.beside(record, overwrite=overwrite)


def _refuse_existing(record: Path, *, overwrite: bool) -> None:
    if record.exists() and not overwrite:
        raise OutputExistsError(
            f"{record} exists: choose another bench, or add --overwrite to replace it"
        )


def write_to_bench(
    folder: Path,
    files: calibrate.WallFiles,
    record: walls.WallRecord,
    reference: walls.BareWall | None,
    *,
    overwrite: bool,
) -> walls.WallRecord:
    """Write a measurement to its `files_in_bench` and enter it in the bench, which is made if it is
    missing; return the record, which names its reference.

    A wall that is measured again drops the occluder found before; the object box stays. Raises
    OutputExistsError without `overwrite` for a record that another process wrote meanwhile.
    """
    with benches.edit_bench(folder) as edit:
        _refuse_existing(files.record, overwrite=overwrite)
        files.record.parent.mkdir(parents=True, exist_ok=True)
        record = calibrate.write_record(files, record, reference)
        name = files.record.relative_to(folder).as_posix()
        before = edit.stations.get(benches.MAIN)
        box = before.object_box if before else record.rig.object_box
        if files.record.stem == "occluder" and before:
            entry = benches.StationRecord(wall=before.wall, occluder=name, object_box=box)
        else:
            entry = benches.StationRecord(wall=name, object_box=box)
        edit.set_station(benches.MAIN, entry, record)
        edit.add(files.record, *([files.reference] if reference else []))
    return record
