"""A device's clock that starts again at zero, made one that goes on."""

from math import ceil

PERIOD_S = 2**32 / 1e6
"""The L515 counts microseconds in 32 bits: its clock wraps every 71.6 minutes."""
STEP_BACK = 1 / 64
"""Of a period: streams come slightly out of order, and their clock is not taken to have wrapped for that."""


class ClockUnwrap:
    """Adds a period to timestamps each time their clock has wrapped.

    They are taken in the order in which they came. What falls back by less than STEP_BACK has not wrapped; what falls
    back further has, so that a gap in the stream may be nearly as long as a period.
    """

    def __init__(self, period_s: float = PERIOD_S) -> None:
        self._period_s, self._step_back_s = period_s, period_s * STEP_BACK
        self._latest_s = float("-inf")

    def add(self, timestamp_s: float) -> float:
        """The timestamp on a clock that does not wrap; itself until the first wrap."""
        behind_s = self._latest_s - self._step_back_s - timestamp_s
        wraps = ceil(behind_s / self._period_s) if behind_s > 0 else 0
        unwrapped_s = timestamp_s + wraps * self._period_s
        self._latest_s = max(self._latest_s, unwrapped_s)
        return unwrapped_s
