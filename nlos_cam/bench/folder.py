"""Bench folder as commands use it: the measured wall of a station, and weights."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import nlos_calibration as walls
from nlos_calibration.errors import CalibrationError, RecordFileError

from nlos_cam.bench.record import (
    MAIN,
    MANIFEST,
    WEIGHTS,
    BenchRecord,
    ForecastRecord,
    StationRecord,
    load_bench_record,
    sha256_of,
)
from nlos_cam.camera import Camera
from nlos_cam.files import CHECKSUMS
from nlos_cam.reconstruct import (
    CalibratedRig,
    check_intrinsics,
    is_other_camera,
    occluder_assumed,
)


@dataclass(frozen=True)
class Bench:
    """A loaded bench folder, whose files fit together and are unchanged since they were written."""

    folder: Path
    record: BenchRecord
    stations: Mapping[str, walls.MeasuredWall]
    """Measured wall of each station, with the bench's object box in its rig."""
    station: str
    """Name of the station in use."""
    weights: Path | None
    """Folder of the bench's own weights, with uncertainty and quality; None if there are none."""

    @property
    def measured(self) -> walls.MeasuredWall:
        """Measured wall of the station in use."""
        return self.stations[self.station]

    @property
    def rig(self) -> walls.Rig:
        """Rig of the station in use, as its lidar's beams see it."""
        return self.measured.record.beam_rig

    @property
    def wall(self) -> Path:
        """Wall record of the station in use, with the occluder if that was measured."""
        return self.folder / self.record.stations[self.station].in_use

    @property
    def expected_iou(self) -> float | None:
        """Silhouette IoU to expect of weights trained for this rig; None where it was not
        forecast.
        """
        found = self.forecast
        return found.expected_iou if found else None

    @property
    def hidden_share(self) -> float:
        """Share of the test objects that change no cell of the maps of this rig; 0 where it was not
        forecast.
        """
        found = self.forecast
        return found.hidden_share if found else 0.0

    @property
    def forecast(self) -> ForecastRecord | None:
        """Forecast of this rig, if there is one."""
        found = self.record.stations[self.station].forecast
        return found if found and found.holds_for(self.rig) else None

    @property
    def can_be_forecast(self) -> bool:
        """True if the occluder was measured, and there is an object box."""
        return self.measured.record.occluder is not None and self.rig.object_box is not None

    @property
    def has_old_forecast(self) -> bool:
        """True if the forecast is of another rig, since the object box was edited, or of an earlier
        version.
        """
        return bool(self.record.stations[self.station].forecast) and self.forecast is None

    @property
    def calibrated(self) -> CalibratedRig:
        """New rig with reference and drift, which starts at its first frame."""
        return CalibratedRig(self.rig, self.measured, self._notes())

    def for_camera(self, camera: Camera) -> CalibratedRig:
        """Return `calibrated` for an opened camera. Raises CalibrationError for another camera than
        the one that the bench was measured with.
        """
        check_intrinsics(self.measured, camera.intrinsics)
        measured = self.record.camera.serial
        given = camera.identity.get("serial", "")
        if is_other_camera(measured, given):
            raise CalibrationError(
                f"{self.folder} was measured with camera {measured}, this is {given}: use that"
                " camera, or calibrate the bench with this one"
            )
        return self.calibrated

    def _notes(self) -> tuple[str, ...]:
        if self.measured.record.occluder:
            return ()
        return (occluder_assumed(self.folder),)


def load_bench(folder: str | Path, station: str = MAIN, *, weights: bool = True) -> Bench:
    """Load a bench folder, and check its files against their checksums and each other.

    Without `weights` its own are neither checked nor named: for commands that replace them, also
    where they are lost or damaged. Raises RecordFileError, with the first problem.
    """
    folder = Path(folder)
    record = load_bench_record(folder)
    _check_station(folder, record, station)
    _check_files(folder, record, weights=weights)
    stations = {name: _measured(folder, record, one) for name, one in record.stations.items()}
    has_weights = weights and f"{WEIGHTS}/{CHECKSUMS}" in record.files
    return Bench(folder, record, stations, station, folder / WEIGHTS if has_weights else None)


def load_bare_wall(folder: str | Path, station: str = MAIN) -> walls.MeasuredWall:
    """Load the bare wall of a bench's station, as it was before the occluder, with the object box.

    Of the other files none is read: the occluder's, which are to be replaced, may be lost or
    damaged. Raises RecordFileError.
    """
    folder = Path(folder)
    record = load_bench_record(folder)
    _check_station(folder, record, station)
    place = record.stations[station]
    if place.wall in record.files:
        _check_file(folder, record, place.wall)
    return _with_box(walls.load_measured(folder / place.wall), place.object_box)


def _check_station(folder: Path, record: BenchRecord, station: str) -> None:
    if station not in record.stations:
        raise RecordFileError(
            f"{folder} has no station {station!r}: choose from {', '.join(record.stations)}"
        )


def _check_files(folder: Path, record: BenchRecord, *, weights: bool) -> None:
    for one in record.stations.values():
        if one.in_use not in record.files:
            raise RecordFileError(
                f"{folder / MANIFEST} has no checksum of {one.in_use}: calibrate the bench again"
            )
    for name in record.files:
        if weights or not name.startswith(f"{WEIGHTS}/"):
            _check_file(folder, record, name)


def _check_file(folder: Path, record: BenchRecord, name: str) -> None:
    """Raise RecordFileError where a file of a bench is lost or has changed."""
    path = folder / name
    again = "adapt" if name.startswith(f"{WEIGHTS}/") else "calibrate"
    try:
        found = sha256_of(path)
    except OSError as error:
        raise RecordFileError(
            f"{path} of the bench cannot be read ({error.strerror}): put it back, or"
            f" {again} the bench again"
        ) from error
    if found != record.files[name]:
        raise RecordFileError(
            f"{path} has changed since the bench was written (its checksum differs from"
            f" {MANIFEST}): put the original back, or {again} the bench again; by hand you may edit"
            f" the object box in {MANIFEST} alone"
        )


def _measured(folder: Path, record: BenchRecord, station: StationRecord) -> walls.MeasuredWall:
    """Return a station's wall, with the bench's object box. Raises RecordFileError where it does
    not fit the bench.
    """
    path = folder / station.in_use
    measured = walls.load_measured(path)
    wall = measured.record
    if wall.serial != record.camera.serial:
        raise RecordFileError(
            f"{path} was measured with camera {wall.serial or 'unknown'}, the bench with"
            f" {record.camera.serial or 'unknown'}: calibrate the bench again"
        )
    if wall.rig.intrinsics != record.camera.intrinsics:
        raise RecordFileError(
            f"{path} has other intrinsics than {MANIFEST}: calibrate the bench again"
        )
    if station.occluder and walls.load_wall(folder / station.wall).rig.lidar != wall.rig.lidar:
        raise RecordFileError(
            f"{path} is of another wall than {station.wall}: find the occluder again with"
            f" `nlos-cam calibrate --occluder {shlex.quote(str(folder))} --overwrite`"
        )
    return _with_box(measured, station.object_box)


def _with_box(measured: walls.MeasuredWall, box: walls.ObjectBox | None) -> walls.MeasuredWall:
    return replace(measured, record=walls.with_object_box(measured.record, box))
