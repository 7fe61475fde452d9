"""Record of a bench folder, `bench.toml`: camera, stations, and the checksums of its files."""

import hashlib
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from nlos_calibration import ObjectBox, PinholeRecord, Record, Rig, read_record, record_kind
from nlos_calibration.errors import RecordFileError
from pydantic import AfterValidator, BeforeValidator, Field

from nlos_cam.files import read_toml
from nlos_cam.forecast import FORECAST_VERSION

if TYPE_CHECKING:
    from nlos_cam.forecast import Forecast

MANIFEST = "bench.toml"
MAIN = "main"
"""Name of the station that is used where none is named."""
STATIONS = "stations"
WEIGHTS = "weights"
"""Folder of a bench with its own weights."""
VERSION = 1
MAKE_ONE = "make a bench with `nlos-cam calibrate --wall --bench bench/`"
MAKE_ANOTHER = "restore it, or make another bench with `nlos-cam calibrate --wall --bench other/`"
"""Of a damaged record: a measurement in the same folder would need it."""


def _known_version(version: Any) -> Any:
    if isinstance(version, int) and version != VERSION:
        raise ValueError(
            f"this nlos-cam reads version {VERSION} only: use the nlos-cam that wrote it, or"
            " calibrate into another bench folder"
        )
    return version


def _inside(name: str) -> str:
    """Return a path below the bench folder. Raises ValueError for any other."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or not path.parts:
        raise ValueError("must be a path inside the bench folder")
    return name


Inside = Annotated[str, AfterValidator(_inside)]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class CameraRecord(Record):
    """The camera that a bench was measured with."""

    serial: str = ""
    """Serial number; empty where unknown."""
    intrinsics: PinholeRecord


class ForecastRecord(Record):
    """Forecast of a station, stored since it takes seconds that `live` does not have."""

    version: int = 0
    """FORECAST_VERSION when it was made; of another one, the forecast is not used."""
    rig_checksum: str
    """Rig that it was made for, likewise."""
    expected_iou: Annotated[float, Field(ge=0, le=1)]
    """Silhouette IoU to expect of weights that are trained for this rig."""
    hidden_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the test objects that change no cell of the maps."""

    @classmethod
    def of(cls, found: "Forecast") -> Self:
        """Return what a bench keeps of a forecast."""
        return cls(
            version=FORECAST_VERSION,
            rig_checksum=found.rig_checksum,
            expected_iou=round(found.expected_iou, 3),
            hidden_share=round(found.hidden_share, 3),
        )

    def holds_for(self, rig: Rig) -> bool:
        """Return whether it is of this rig, and made as forecasts are made today."""
        return self.version == FORECAST_VERSION and self.rig_checksum == rig.checksum


class StationRecord(Record):
    """One pose of the lidar, with its measurements. A second pose has a wall frame of its own."""

    wall: Inside
    """Record of the bare wall: its path in the bench folder."""
    occluder: Inside | None = None
    """Record of the same wall with the occluder in place; None until that was measured."""
    object_box: ObjectBox | None = None
    """Box of the hidden object in the station's wall frame; to be edited by hand."""
    forecast: ForecastRecord | None = None
    """None until the occluder was measured."""

    @property
    def in_use(self) -> str:
        """Path of the record that describes the bench as it stands."""
        return self.occluder or self.wall


class BenchRecord(Record):
    """Content of a bench folder, except for the measurements, which are in files of their own."""

    bench_version: Annotated[Literal[1], BeforeValidator(_known_version)] = VERSION
    created: datetime
    changed: datetime
    program: str
    """Program and version that wrote it last."""
    camera: CameraRecord
    stations: Annotated[dict[str, StationRecord], Field(min_length=1)]
    files: dict[Inside, Sha256]
    """SHA-256 of each file by its path; weights count by their own SHA256SUMS."""


def station_folder(name: str) -> str:
    """Return the path of a station's files in the bench folder."""
    return f"{STATIONS}/{name}"


def is_bench(folder: Path) -> bool:
    """Return whether a path is a folder with the record of a bench; a damaged record counts."""
    path = folder / MANIFEST
    if not path.is_file():
        return False
    try:
        kind = record_kind(read_toml(path))
    except (OSError, ValueError):
        return True
    return kind in {"", "bench"}


def load_bench_record(folder: Path) -> BenchRecord:
    """Read the record of a bench folder, without its files. Raises RecordFileError."""
    if folder.is_file():
        raise RecordFileError(
            f"{folder} is a file, not a bench folder: name the folder that holds {MANIFEST}, or"
            " give a wall record as --wall"
        )
    if not folder.exists():
        raise RecordFileError(f"no bench folder {folder}: {MAKE_ONE}")
    if not (folder / MANIFEST).exists():
        raise RecordFileError(f"{folder} is not a bench folder (no {MANIFEST}): {MAKE_ONE}")
    return read_record(folder / MANIFEST, BenchRecord, "bench", MAKE_ANOTHER)


def sha256_of(path: Path) -> str:
    """Return the checksum of a file, 64 hexadecimal digits. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
