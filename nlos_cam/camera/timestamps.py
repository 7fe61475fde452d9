"""Frame numbers and timestamps that keep rising when a device's clock wraps or the device
restarts.
"""

from dataclasses import replace
from math import ceil

from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.frames import Frame

WRAP_PERIOD_S = 2**32 / 1e6
"""The L515 counts microseconds in 32 bits: its clock wraps every 71.6 minutes."""
STEP_BACK = 1 / 64
"""Share of a period that a timestamp may fall back without a wrap: streams come slightly out of
order.
"""


class ClockUnwrap:
    """Unwrapped clock of one stream: adds a period to timestamps, fed in order of arrival, at each
    wrap.
    """

    def __init__(self, period_s: float = WRAP_PERIOD_S) -> None:
        self._period_s = period_s
        self._step_back_s = period_s * STEP_BACK
        self._latest_s = float("-inf")

    def add(self, timestamp_s: float) -> float:
        """Return the timestamp on a clock that does not wrap; unchanged until the first wrap."""
        # The true time is t + k P with an unknown whole k. Take the smallest k that does not fall
        # back behind the latest time by more than the tolerance s: t + k P >= latest - s, so k =
        # ceil((latest - s - t) / P). A later k would fit as well, so gaps of up to P - s (70
        # minutes) are resolved, longer ones are not.
        behind_s = self._latest_s - self._step_back_s - timestamp_s
        wraps = ceil(behind_s / self._period_s) if behind_s > 0 else 0
        unwrapped_s = timestamp_s + wraps * self._period_s
        self._latest_s = max(self._latest_s, unwrapped_s)
        return unwrapped_s


FRAME_PERIOD_S = 1 / FRAMES_PER_S
SAME_CLOCK_S = 1.0
"""Device and host clocks that agree on an outage to within this ran on through it."""


class Continuity:
    """Renumbering over restarts of a device or its count, so that numbers and timestamps rise together at 30
    frames/s.

    Stateful: feed frames in order, from one thread. An outage lasts as long as the device's clock
    says, or the host's where the device's was reset. Its frame numbers are skipped, and counted in
    `missed`.
    """

    def __init__(self) -> None:
        self.missed = 0
        self.added_s = 0.0
        """What is added to the device's timestamps now."""
        self._add_number = 0
        self._last: Frame | None = None
        self._last_arrived_s = 0.0
        self._restarted = False
        self._counted = 0

    def restart(self, counted: int) -> None:
        """Note that the device was started again, and how many numbers since the last frame are
        counted elsewhere.
        """
        self._restarted = True
        self._counted += counted

    def add(self, frame: Frame, arrived_s: float) -> Frame:
        """Return the frame renumbered; `arrived_s` is on the host's clock."""
        last = self._last
        if last and (self._restarted or frame.frame_number + self._add_number < last.frame_number):
            self._splice(last, frame, arrived_s)  # also where the device restarts its count alone
        self._restarted = False
        self._counted = 0
        if self._add_number or self.added_s:
            number = frame.frame_number + self._add_number
            timestamp_s = frame.timestamp_s + self.added_s
            frame = replace(frame, frame_number=number, timestamp_s=timestamp_s)
        self._last = frame
        self._last_arrived_s = arrived_s
        return frame

    def _splice(self, last: Frame, frame: Frame, arrived_s: float) -> None:
        """Set what is added to numbers and timestamps from this frame on."""
        # The outage as two clocks see it. The device's is finer, but only if it ran on: a clock
        # that was reset falls back, or differs from the host's by more than a delivery can be late.
        # Then the host's replaces it.
        host_s = max(FRAME_PERIOD_S, arrived_s - self._last_arrived_s)
        device_s = frame.timestamp_s + self.added_s - last.timestamp_s
        if device_s < FRAME_PERIOD_S / 2 or abs(device_s - host_s) > SAME_CLOCK_S:
            self.added_s += host_s - device_s
            device_s = host_s
        # The frame stands n >= 1 periods after the last one; of the n - 1 numbers in between, those
        # that the last session counted as incomplete or dropped are not counted again.
        periods = max(1, round(device_s * FRAMES_PER_S))
        self._add_number = last.frame_number + periods - frame.frame_number
        self.missed += max(0, periods - 1 - self._counted)
