"""The temperatures of a camera from time to time, told with the frames they belong to."""

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from nlos_cam.camera import Camera
from nlos_cam.errors import RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording import TEMPERATURE_INTERVAL_S, load_sidecar, sidecar_path

RECORDED = "bag:"
Celsius = Mapping[str, float]

log = logging.getLogger(__name__)


class Telemetry:
    """Reads temperatures, by `read` of the seconds since the first frame, in the thread that reads the frames.

    Asking a real device takes time on its link: it is done every `every_s` of the frames' time, and not by who
    reconstructs them. The thread that starts and stops a device anew is the one that asks.
    """

    def __init__(self, read: Callable[[float], Celsius], every_s: float = TEMPERATURE_INTERVAL_S) -> None:
        self._read, self._every_s = read, every_s
        self._readings: deque[tuple[int, Celsius]] = deque()
        self.celsius: Celsius = {}
        """The last reading that `at` gave."""

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The same frames."""
        first_s, due_s = None, float("-inf")
        for frame in frames:
            if frame.timestamp_s >= due_s:
                first_s = frame.timestamp_s if first_s is None else first_s
                due_s = frame.timestamp_s + self._every_s
                if celsius := self._read(frame.timestamp_s - first_s):
                    self._readings.append((frame.frame_number, celsius))
            yield frame

    def at(self, frame: Frame) -> Celsius | None:
        """The last reading up to this frame, once; None if there is no new one. May be called by another thread."""
        newest: Celsius | None = None
        while self._readings and self._readings[0][0] <= frame.frame_number:
            newest = self.celsius = self._readings.popleft()[1]
        return newest


def telemetry_of(camera: Camera) -> Telemetry:
    """Of a device, or of the sidecar that lies beside a recording."""
    path = sidecar_path(Path(camera.uri.removeprefix(RECORDED)))
    if not camera.uri.startswith(RECORDED) or not path.is_file():
        return Telemetry(lambda _: camera.telemetry("_temperature"))
    try:
        series = load_sidecar(path).temperatures
    except RecordingError as error:
        log.warning("no temperatures: %s", error)
        series = []

    def recorded(time_s: float) -> Celsius:
        return next((look.celsius for look in reversed(series) if look.time_s <= time_s), {})

    return Telemetry(recorded)
