"""Writing of a bench folder: files first, then its record with their checksums."""

import os
import shlex
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import nlos_calibration as walls
from nlos_calibration.errors import CalibrationError, RecordFileError
from nlos_models import RECORD, load_record
from nlos_models.errors import CheckpointError

from nlos_cam import __version__
from nlos_cam.bench.folder import load_bench
from nlos_cam.bench.record import (
    MANIFEST,
    STATIONS,
    WEIGHTS,
    BenchRecord,
    CameraRecord,
    ForecastRecord,
    StationRecord,
    is_bench,
    load_bench_record,
    sha256_of,
)
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import (
    CHECKSUMS,
    atomic_directory,
    atomic_file,
    damaged_files,
    write_checked,
)
from nlos_cam.reconstruct import weights_serve

TEST_IOU = "test_iou"
"""Figure of a bench's weights: silhouette IoU on the 54 test objects on its rig."""


class BenchEdit:
    """Changes of a bench folder, which this process holds."""

    def __init__(self, folder: Path, before: BenchRecord | None) -> None:
        self.folder = folder
        self.before = before
        """Record as it was; None for a new bench."""
        self.camera = before.camera if before else None
        self.stations = dict(before.stations) if before else {}
        self._files = dict(before.files) if before else {}

    def set_station(self, name: str, station: StationRecord, wall: walls.WallRecord) -> None:
        """Enter a station whose record in use is `wall`, and its camera. The files of an
        occluder that it no longer names are removed.

        Raises CalibrationError where other stations were measured with another camera.
        """
        camera = CameraRecord(serial=wall.serial, intrinsics=wall.rig.intrinsics)
        if self.camera and self.camera != camera and set(self.stations) - {name}:
            raise CalibrationError(
                f"{self.folder} has stations of camera {self.camera.serial}: make another bench for"
                f" {wall.serial or 'this camera'}"
            )
        before = self.stations.get(name)
        self.camera = camera
        self.stations[name] = station
        if before and before.occluder and before.occluder != station.occluder:
            for suffix in (".toml", ".npz", ".html"):
                path = Path(before.occluder).with_suffix(suffix)
                self._files.pop(path.as_posix(), None)
                (self.folder / path).unlink(missing_ok=True)

    def set_forecast(self, name: str, forecast: ForecastRecord) -> None:
        """Enter the forecast of a station."""
        self.stations[name] = self.stations[name].model_copy(update={"forecast": forecast})

    def add(self, *paths: Path) -> None:
        """Enter files that were written, or written again, with their checksums."""
        for path in paths:
            self._files[path.relative_to(self.folder).as_posix()] = sha256_of(path)

    def record(self) -> BenchRecord:
        """Return the record of the bench with its changes. Raises RecordFileError without a
        station.
        """
        if self.camera is None or not self.stations:
            raise RecordFileError(
                f"{self.folder} has no measured wall: run `nlos-cam calibrate --wall --bench"
                f" {shlex.quote(str(self.folder))}` first"
            )
        now = datetime.now(UTC).replace(microsecond=0)
        return BenchRecord(
            created=self.before.created if self.before else now,
            changed=now,
            program=f"nlos-cam {__version__}",
            camera=self.camera,
            stations=self.stations,
            files=dict(sorted(self._files.items())),
        )


def check_new(folder: Path) -> None:
    """Raise OutputExistsError where a bench cannot be made or continued at a path, RecordFileError
    where the record of the one that is there cannot be read.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise OutputExistsError(f"{folder} is a file, but --bench must be a folder: choose another")
    whole = folder.absolute()
    nearest = next(path for path in (whole, *whole.parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise OutputExistsError(
            f"{folder} cannot be made, because {nearest} is a file: choose another --bench"
        )
    if not os.access(nearest, os.W_OK):
        raise OutputExistsError(
            f"{folder} cannot be written, since {nearest} is read-only: choose another --bench, or"
            " change its permissions"
        )
    if is_bench(folder):
        load_bench_record(folder)
    elif folder.is_dir() and not all(map(_is_unfinished, folder.iterdir())):
        raise OutputExistsError(
            f"{folder} holds other files and no bench: choose another name for --bench"
        )


def _is_unfinished(path: Path) -> bool:
    """Return whether something in a folder is what a first measurement leaves that was stopped."""
    return path.name == STATIONS or path.name.startswith(".")


@contextmanager
def edit_bench(folder: Path) -> Generator[BenchEdit]:
    """Hold a bench folder, which is made if it is missing, with the folders above it, and write its
    record on success.

    The record comes last: a kill before leaves files that do not match it, which `load_bench`
    names. Raises FileBusyError while another process holds it, RecordFileError for a damaged one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_file(folder / MANIFEST) as part:
        before = load_bench_record(folder) if (folder / MANIFEST).exists() else None
        edit = BenchEdit(folder, before)
        yield edit
        part.write_text(walls.dump_toml(edit.record()), encoding="utf-8")


def iou_in_use(folder: Path) -> float | None:
    """Return the silhouette IoU of a bench's own weights on the test objects on it; None where it
    has none of this rig that can be read.
    """
    try:
        loaded = load_bench(folder)
        record = load_record(loaded.weights) if loaded.weights else None
    except (CheckpointError, RecordFileError):  # of the weights: what is measured is checked before
        return None
    if record is None or weights_serve(loaded.rig, record).service != "trained for it":
        return None
    return record.figures.get(TEST_IOU)


def write_weights(folder: Path, source: Path, test_iou: float | None = None) -> Path:
    """Copy a folder of weights, with uncertainty and quality, into a bench as its own; return where
    they are.

    Weights of exactly this bench's rig get the rig into their record, by which `weights_serve`
    knows them when the bench is measured again, and their IoU on the test objects on it. Raises
    CheckpointError for a folder without weights, or with damaged ones, RecordFileError for a bench
    that is damaged.
    """
    record = load_record(source)
    if damaged := damaged_files(source):
        raise CheckpointError(
            f"{source / damaged[0]} is missing or damaged, so the weights of {folder} stay: copy or"
            " train them again"
        )
    rig = load_bench(folder, weights=False).rig
    out = folder / WEIGHTS
    with edit_bench(folder) as edit:
        names = sorted(path.name for path in source.iterdir() if path.is_file())
        # an uncertainty network of earlier weights would watch others than those beside it
        with atomic_directory(out, drop=["*"]) as part:
            for name in names:
                shutil.copyfile(source / name, part / name)
            fields = rig.model_dump(mode="json")
            # weights on the wall grid name the grid, and hold the rig that they went on for
            if record.rig_checksum == rig.checksum or record.rig == fields:
                figures = record.figures | ({} if test_iou is None else {TEST_IOU: test_iou})
                update = {"rig": fields, "figures": figures}
                known = record.model_copy(update=update)
                write_checked(part, {RECORD: f"{known.model_dump_json(indent=2)}\n".encode()})
            elif not (part / CHECKSUMS).exists():
                write_checked(part, {name: (part / name).read_bytes() for name in names})
        edit.add(out / CHECKSUMS)
    return out
