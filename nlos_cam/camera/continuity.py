"""One rising count of frames and seconds over the restarts of a device that begins anew with both."""

from dataclasses import dataclass, replace

from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.frames import Frame

PERIOD_S = 1 / FRAMES_PER_S
SAME_CLOCK_S = 1.0
"""A device whose clock tells of an outage what the host's does, to within this, did not set its clock anew."""


@dataclass(frozen=True)
class Seen:
    """The last frame that was passed on, and when."""

    number: int
    timestamp_s: float
    arrived_s: float


class Continuity:
    """Renumbers what comes after a restart, such that numbers and timestamps rise together at 30 frames/s.

    The outage lasted as long as the device's clock says, or the host's where the device's began anew. The numbers that
    it would have filled are left out, and counted in `missed`.
    """

    def __init__(self) -> None:
        self.missed = 0
        self._later, self._later_s = 0, 0.0
        self._last: Seen | None = None
        self._anew = False
        self._counted = 0

    def restart(self, counted: int) -> None:
        """What comes next is of a device that was started again; so many numbers since the last frame are counted."""
        self._anew = True
        self._counted += counted

    def add(self, frame: Frame, arrived_s: float) -> Frame:
        """The frame as it is passed on; `arrived_s` is by the host's clock."""
        if self._anew and self._last:
            self._splice(self._last, frame, arrived_s)
        self._anew, self._counted = False, 0
        number, timestamp_s = frame.frame_number + self._later, frame.timestamp_s + self._later_s
        self._last = Seen(number, timestamp_s, arrived_s)
        return replace(frame, frame_number=number, timestamp_s=timestamp_s) if self._later or self._later_s else frame

    def _splice(self, last: Seen, frame: Frame, arrived_s: float) -> None:
        host_s = max(PERIOD_S, arrived_s - last.arrived_s)
        device_s = frame.timestamp_s + self._later_s - last.timestamp_s
        if device_s < PERIOD_S / 2 or abs(device_s - host_s) > SAME_CLOCK_S:
            self._later_s += host_s - device_s
            device_s = host_s
        periods = max(1, round(device_s * FRAMES_PER_S))
        self._later = last.number + periods - frame.frame_number
        self.missed += max(0, periods - 1 - self._counted)
