"""Sidecar of a recording, F.json beside F.bag: device, settings, temperatures, calibration, label,
summary.
"""

import hashlib
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

from nlos_calibration import Finite, PinholeRecord, Record, Rig, first_problem, load_wall
from pydantic import AwareDatetime, Field, ValidationError

from nlos_cam import __version__
from nlos_cam.camera import SIDECAR_SUFFIX, Camera
from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.files import TEXT_LIMIT, atomic_file, describe, program_commit, read_bounded
from nlos_cam.frames import Frame
from nlos_cam.recording.bag_messages import finite
from nlos_cam.recording.bag_reader import packaged_or_file
from nlos_cam.recording.playback import VerifyResult
from nlos_cam.recording.quality import Quality

TakeState = Literal[
    "recording",
    "complete",
    "interrupted",
    "lost",
    "disk full",
    "size limit",
    "file gone",
    "damaged",
]
"""recording: in progress, or killed. interrupted: by Ctrl-C. lost: the camera vanished. size limit:
the file reached the system's limit on its size. file gone: the file, or its disk, went away.
damaged: it holds fewer frames than came.
"""
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
SDK = "pyrealsense2"
TEMPERATURE_INTERVAL_S = 10.0
"""Seconds between temperature readings, each of which rewrites the file."""
MAX_TEMPERATURES = 1000
"""Bound on the readings in the file; beyond it every other one is dropped, and the interval
doubles.
"""


class Temperatures(Record):
    """Reading of the device's thermometers."""

    time_s: Finite
    """Since the first frame, on the device's clock."""
    celsius: dict[str, Finite]
    """By the SDK's name of the option."""


class WallFile(Record):
    """Wall record given with `--wall`."""

    path: str
    sha256: str


class Summary(Record):
    """Verified contents of the file, and quality of the frames."""

    frames: Count | None = None
    """Complete sets in the file; of one without an index, the frames that a repair recovers. None
    where not verified.
    """
    dropped: Count | None = None
    seconds: Finite | None = None
    frames_per_s: Finite | None = None
    streams: dict[str, Count]
    """Frames of each stream in the file."""
    events: dict[str, int]
    """Faults of the camera, counted by name."""
    frames_seen: Count = 0
    """Frames behind the quality figures that follow."""
    saturated_share: Share | None = None
    invalid_share: Share | None = None
    confidence_mean: Annotated[float, Field(ge=0, le=15)] | None = None
    temporal_noise_mm: Finite | None = None
    jitter_ms: Finite | None = None


class Sidecar(Record):
    """Content of a sidecar file."""

    schema_version: Literal[1] = 1
    label: str | None
    camera: str
    """The camera's URI."""
    state: TakeState
    started: AwareDatetime
    """UTC."""
    device: dict[str, str]
    """name, serial, firmware, usb_type, as far as the device reports them."""
    versions: dict[str, str]
    intrinsics: PinholeRecord
    """Of the depth stream; infrared and confidence share it."""
    rig: Rig | None = None
    """Measured with `wall`, or known for a simulated camera."""
    wall: WallFile | None = None
    settings: dict[str, Finite]
    """All options of the depth sensor at the start of the recording, as read from the device."""
    temperatures: list[Temperatures]
    summary: Summary | None = None
    """None until the recording has ended."""


def sidecar_path(recording: Path) -> Path:
    """Return F.json for F.bag, and for a bag of ROS 2 in a folder F; that of the packaged recording
    does not exist.
    """
    recording = packaged_or_file(recording)
    if not recording.is_dir():
        return recording.with_suffix(SIDECAR_SUFFIX)
    named = recording if recording.name not in {"", ".."} else recording.resolve()
    return named.with_name(f"{named.name}{SIDECAR_SUFFIX}")


def load_sidecar(path: Path) -> Sidecar:
    """Read a sidecar. Raises RecordingError, with the first problem, for any other file."""
    try:
        return Sidecar.model_validate_json(read_bounded(path, TEXT_LIMIT), strict=True)
    except FileNotFoundError as error:
        raise RecordingError(
            f"no sidecar {path}: `nlos-cam capture` writes one beside each recording"
        ) from error
    except ValidationError as error:
        raise RecordingError(f"{path} is not a sidecar: {first_problem(error)}") from error
    except (OSError, MemoryError) as error:
        raise RecordingError(f"{path} cannot be read: {describe(error)}") from error


def recorded_wall(recording: Path) -> WallFile | None:
    """Return the wall record that a recording's sidecar names; None without one."""
    try:
        return load_sidecar(sidecar_path(recording)).wall
    except RecordingError:
        return None


def versions() -> dict[str, str]:
    """Return the versions of this program, its commit, librealsense's Python package and Python,
    and the platform.
    """
    found = {
        "nlos-cam": __version__,
        "commit": program_commit(),
        "python": platform.python_version(),
        "platform": f"{platform.system().lower()} {platform.machine()}",
    }
    with suppress(PackageNotFoundError):  # librealsense has no package for some machines
        found[SDK] = version(SDK)
    return found


def load_measured_wall(path: Path) -> tuple[Rig, WallFile]:
    """Return the rig of a wall record, and its path and checksum. Raises RecordFileError for any
    other file.
    """
    return load_wall(path).beam_rig, WallFile(
        path=str(path), sha256=hashlib.sha256(path.read_bytes()).hexdigest()
    )


def summary_of(found: VerifyResult | None, quality: Quality, events: Mapping[str, int]) -> Summary:
    """Return the summary of a recording; None where it was not verified."""
    figures: dict[str, Any] = asdict(quality) | {"events": dict(events), "streams": {}}
    if found:
        figures |= asdict(found)
        figures["frames_per_s"] = (found.frames - 1) / found.seconds if found.seconds > 0 else None
    return Summary.model_validate(figures)


class SidecarFile:
    """Sidecar during a recording; its file is replaced atomically at each update. For one thread;
    `finish` ends it.

    Creating and finishing it raise DiskFullError where it cannot be written.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        *,
        label: str | None = None,
        wall: tuple[Rig, WallFile] | None = None,
        started: datetime | None = None,
    ) -> None:
        self.path = path
        self._first_s: float | None = None
        self._read_s = float("-inf")
        self._every_s = TEMPERATURE_INTERVAL_S
        self._camera = camera
        self._sidecar = Sidecar(
            label=label,
            camera=camera.uri,
            state="recording",
            started=started or datetime.now(UTC),
            device=dict(camera.identity),
            versions=versions(),
            intrinsics=PinholeRecord.model_validate(vars(camera.intrinsics)),
            rig=wall[0] if wall else camera.rig,
            wall=wall[1] if wall else None,
            settings=finite(camera.telemetry()),
            temperatures=[],
        )
        self._write()

    def on_frame(self, frame: Frame) -> None:
        """Record the settings of the first frame, and the temperatures every
        TEMPERATURE_INTERVAL_S.
        """
        if self._first_s is None:
            self._first_s = frame.timestamp_s
            self._sidecar = self._sidecar.model_copy(update={"settings": finite(frame.settings)})
        # A clock that went back starts the interval again.
        if not self._read_s <= frame.timestamp_s < self._read_s + self._every_s:
            self._read_s = frame.timestamp_s
            self._read_temperatures(frame.timestamp_s - self._first_s)
            with suppress(DiskFullError):  # the end of the recording raises it
                self._write()

    def _read_temperatures(self, time_s: float) -> None:
        celsius = finite(self._camera.telemetry("_temperature"))
        if not celsius:
            return
        series = [*self._sidecar.temperatures, Temperatures(time_s=time_s, celsius=celsius)]
        if len(series) > MAX_TEMPERATURES:
            series = series[::2]
            self._every_s = 2 * self._every_s
        self._sidecar = self._sidecar.model_copy(update={"temperatures": series})

    def finish(self, state: TakeState, summary: Summary) -> None:
        """Write the final state and summary."""
        self._sidecar = self._sidecar.model_copy(update={"state": state, "summary": summary})
        self._write()

    def _write(self) -> None:
        try:
            with atomic_file(self.path) as part:
                part.write_text(self._sidecar.model_dump_json(indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise DiskFullError(
                f"{self.path} cannot be written ({describe(error)}): free some space"
            ) from error
