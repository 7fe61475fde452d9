"""A device's clock that starts again at zero, made one that goes on.

One rising count of frames and seconds over the restarts of a device that begins anew with both.
"""

from dataclasses import dataclass, replace
from math import ceil

from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.frames import Frame

WRAP_PERIOD_S = 2**32 / 1e6
"""The L515 counts microseconds in 32 bits: its clock wraps every 71.6 minutes."""
STEP_BACK = 1 / 64
"""Of a period: streams come slightly out of order, and their clock is not taken to have wrapped for that."""


class ClockUnwrap:
    """Adds a period to timestamps each time their clock has wrapped.

    They are taken in the order in which they came. What falls back by less than STEP_BACK has not wrapped; what falls
    back further has, so that a gap in the stream may be nearly as long as a period.
    """

    def __init__(self, period_s: float = WRAP_PERIOD_S) -> None:
        self._period_s, self._step_back_s = period_s, period_s * STEP_BACK
        self._latest_s = float("-inf")

    def add(self, timestamp_s: float) -> float:
        """The timestamp on a clock that does not wrap; itself until the first wrap."""
        behind_s = self._latest_s - self._step_back_s - timestamp_s
        wraps = ceil(behind_s / self._period_s) if behind_s > 0 else 0
        unwrapped_s = timestamp_s + wraps * self._period_s
        self._latest_s = max(self._latest_s, unwrapped_s)
        return unwrapped_s


FRAME_PERIOD_S = 1 / FRAMES_PER_S
SAME_CLOCK_S = 1.0
"""A device whose clock tells of an outage what the host's does, to within this, did not set its clock anew."""


@dataclass(frozen=True)
class LastFrame:
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
        self._last: LastFrame | None = None
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
        self._last = LastFrame(number, timestamp_s, arrived_s)
        return replace(frame, frame_number=number, timestamp_s=timestamp_s) if self._later or self._later_s else frame

    def _splice(self, last: LastFrame, frame: Frame, arrived_s: float) -> None:
        host_s = max(FRAME_PERIOD_S, arrived_s - last.arrived_s)
        device_s = frame.timestamp_s + self._later_s - last.timestamp_s
        if device_s < FRAME_PERIOD_S / 2 or abs(device_s - host_s) > SAME_CLOCK_S:
            self._later_s += host_s - device_s
            device_s = host_s
        periods = max(1, round(device_s * FRAMES_PER_S))
        self._later = last.number + periods - frame.frame_number
        self.missed += max(0, periods - 1 - self._counted)
