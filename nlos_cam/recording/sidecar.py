"""The record beside a recording, F.json beside F.bag: device, settings, temperatures, calibration, label, summary."""

import hashlib
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

from nlos_calibration import Finite, PinholeRecord, Record, Rig, first_problem, load_wall
from pydantic import AwareDatetime, Field, ValidationError

from nlos_cam.camera import Camera
from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.files import atomic_file
from nlos_cam.frames import Frame
from nlos_cam.recording.playback import Verified
from nlos_cam.recording.quality import Quality

State = Literal["recording", "complete", "interrupted", "lost", "disk full", "damaged"]
"""While it records, or after it was killed: recording. Ended by Ctrl-C: interrupted. The camera vanished: lost.

damaged: the file holds less than came.
"""
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
PACKAGES = ("nlos-cam", "pyrealsense2")
LOOK_S = 10.0
"""Temperatures are looked at, and the file is written anew, about so often."""
MAX_LOOKS = 1000
"""Beyond so many, every other one is forgotten, and only every other one is kept from then on."""


class Temperatures(Record):
    """One look at the device's thermometers."""

    time_s: Finite
    """Since the first frame, by the device's clock."""
    celsius: dict[str, Finite]
    """By the SDK's name of the option."""


class WallFile(Record):
    """The wall record that `--wall` named."""

    path: str
    sha256: str


class Summary(Record):
    """What the file holds, read back, and how good the frames were."""

    frames: Count | None = None
    """Complete sets in the file; None where it was not read back."""
    dropped: Count | None = None
    seconds: Finite | None = None
    frames_per_s: Finite | None = None
    streams: dict[str, Count]
    """Frames of each stream in the file."""
    events: dict[str, int]
    """What befell the camera, by name, as it counts."""
    frames_seen: Count = 0
    """By those figures that follow."""
    saturated_share: Share | None = None
    invalid_share: Share | None = None
    confidence_mean: Annotated[float, Field(ge=0, le=15)] | None = None
    temporal_noise_mm: Finite | None = None
    jitter_ms: Finite | None = None


class Sidecar(Record):
    """All that is known of a recording beside its frames."""

    schema_version: Literal[1] = 1
    label: str | None
    camera: str
    """The camera's URI."""
    state: State
    started: AwareDatetime
    """UTC."""
    device: dict[str, str]
    """name, serial, firmware, usb_type, where the device tells them."""
    versions: dict[str, str]
    intrinsics: PinholeRecord
    """Of the depth stream; infrared and confidence share it."""
    rig: Rig | None = None
    """The bench: measured, with `wall`, or known to a simulated camera."""
    wall: WallFile | None = None
    settings: dict[str, Finite]
    """Every option of the depth sensor, as read back when the recording began."""
    temperatures: list[Temperatures]
    summary: Summary | None = None
    """None until the recording has ended."""


def sidecar_path(recording: Path) -> Path:
    """F.json of F.bag."""
    return recording.with_suffix(".json")


def load_sidecar(path: Path) -> Sidecar:
    """Read a sidecar. Raises RecordingError, with the first problem, where it is not one."""
    try:
        return Sidecar.model_validate_json(path.read_bytes(), strict=True)
    except FileNotFoundError as error:
        raise RecordingError(f"no sidecar {path}: `nlos-cam capture` writes one beside each recording") from error
    except ValidationError as error:
        raise RecordingError(f"{path} is not a sidecar: {first_problem(error)}") from error
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error


def versions() -> dict[str, str]:
    """Of this program, librealsense's wheel and Python; and the kind of machine."""
    found = {"python": platform.python_version(), "platform": f"{platform.system().lower()} {platform.machine()}"}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):  # librealsense has no wheel for every machine
            found[package] = version(package)
    return found


def wall_of(path: Path) -> tuple[Rig, WallFile]:
    """The measured rig, and which file it is from. Raises RecordFileError where it is no wall record."""
    return load_wall(path).rig, WallFile(path=str(path), sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def summary_of(found: Verified | None, quality: Quality, events: Mapping[str, int]) -> Summary:
    """The summary of a recording that was read back, or was not."""
    figures: dict[str, Any] = asdict(quality) | {"events": dict(events), "streams": {}}
    if found:
        figures |= asdict(found)
        figures["frames_per_s"] = (found.frames - 1) / found.seconds if found.seconds > 0 else None
    return Summary.model_validate(figures)


def _finite(values: Mapping[str, float]) -> dict[str, float]:
    """JSON has no other numbers."""
    return {name: value for name, value in values.items() if isfinite(value)}


class SidecarFile:
    """A sidecar as a recording goes on, and its file, which is whole at any time.

    Raises DiskFullError on making and on finishing it, where it cannot be written.
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
        self._looked_s, self._every_s = float("-inf"), LOOK_S
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
            settings=_finite(camera.telemetry()),
            temperatures=[],
        )
        self._write()

    def on_frame(self, frame: Frame) -> None:
        """Take note of the settings, and of temperatures from time to time."""
        if self._first_s is None:
            self._first_s = frame.timestamp_s
            self._sidecar = self._sidecar.model_copy(update={"settings": _finite(frame.settings)})
        if frame.timestamp_s - self._looked_s >= self._every_s:
            self._looked_s = frame.timestamp_s
            self._look(frame.timestamp_s - self._first_s)
            with suppress(DiskFullError):  # the recording's own end tells
                self._write()

    def _look(self, time_s: float) -> None:
        celsius = _finite(self._camera.telemetry("_temperature"))
        if not celsius:
            return
        series = [*self._sidecar.temperatures, Temperatures(time_s=time_s, celsius=celsius)]
        if len(series) > MAX_LOOKS:
            series, self._every_s = series[::2], 2 * self._every_s
        self._sidecar = self._sidecar.model_copy(update={"temperatures": series})

    def finish(self, state: State, summary: Summary) -> None:
        """Write how it ended."""
        self._sidecar = self._sidecar.model_copy(update={"state": state, "summary": summary})
        self._write()

    def _write(self) -> None:
        try:
            with atomic_file(self.path) as part:
                part.write_text(self._sidecar.model_dump_json(indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise DiskFullError(f"{self.path} cannot be written ({error.strerror}): free some space") from error
