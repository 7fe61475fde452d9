"""Temperatures of a camera or a recording, read periodically and matched to frames."""

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from nlos_cam.camera import Camera
from nlos_cam.errors import RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.sidecar import TEMPERATURE_INTERVAL_S, load_sidecar, sidecar_path

RECORDED = "bag:"
Celsius = Mapping[str, float]

log = logging.getLogger(__name__)


class Telemetry:
    """Periodic reader of temperatures; `read` takes the seconds since the first frame.

    `watch` reads every `every_s` of the frames' time, in the thread that reads the frames: a real
    device needs time to answer, and only the thread that restarts a device may ask it. `at` may be
    called from another thread.
    """

    def __init__(
        self, read: Callable[[float], Celsius], every_s: float = TEMPERATURE_INTERVAL_S
    ) -> None:
        self._read = read
        self._every_s = every_s
        self._readings: deque[tuple[int, Celsius]] = deque()
        self.celsius: Celsius = {}
        """Last reading that `at` returned."""

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the same frames, and read when due."""
        first_s = None
        read_s = float("-inf")
        for frame in frames:
            # A clock that went back starts the interval again.
            if not read_s <= frame.timestamp_s < read_s + self._every_s:
                first_s = frame.timestamp_s if first_s is None else first_s
                read_s = frame.timestamp_s
                if celsius := self._read(frame.timestamp_s - first_s):
                    self._readings.append((frame.frame_number, celsius))
            yield frame

    def at(self, frame: Frame) -> Celsius | None:
        """Return the last reading up to this frame, once; None if there is no new one."""
        newest: Celsius | None = None
        while self._readings and self._readings[0][0] <= frame.frame_number:
            newest = self.celsius = self._readings.popleft()[1]
        return newest


def telemetry_of(camera: Camera, every_s: float = TEMPERATURE_INTERVAL_S) -> Telemetry:
    """Return the telemetry of a device, or of a recording's sidecar if it has one."""
    path = sidecar_path(Path(camera.uri.removeprefix(RECORDED)))
    if not camera.uri.startswith(RECORDED) or not path.is_file():
        return Telemetry(lambda _: camera.telemetry("_temperature"), every_s)
    try:
        series = load_sidecar(path).temperatures
    except RecordingError as error:
        log.warning("no temperatures: %s", error)
        series = []
    return Telemetry(
        lambda time_s: next(
            (each.celsius for each in reversed(series) if each.time_s <= time_s), {}
        ),
        every_s,
    )


def with_telemetry(
    camera: Camera, every_s: float = TEMPERATURE_INTERVAL_S
) -> tuple[Iterator[Frame], Telemetry]:
    """Return the camera's frames and its telemetry, which is read as they pass."""
    telemetry = telemetry_of(camera, every_s)
    return telemetry.watch(camera), telemetry
