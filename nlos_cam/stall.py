"""Notices that a camera gives no frames any more, and that it gives some again."""

from collections.abc import Callable

STALLED_AFTER_S = 0.5
"""Fifteen frames: no pause of a camera that is well is as long."""
STALLED = f"the camera stalled: no frame for {STALLED_AFTER_S:g} s, what is shown is old"

OnStall = Callable[[str, bool], None]
"""Called with what to tell, and whether it begins (or ends)."""


class StallWatch:
    """Tells of each stall once, however often it looks."""

    def __init__(self, on_stall: OnStall) -> None:
        self.stalls = 0
        self.stalled_s = 0.0
        """In all, from the last frame before each stall to the first after it."""
        self._on_stall = on_stall
        self._since_s: float | None = None
        """The last frame's arrival, while stalled."""
        self._told_s = 0.0

    def look(self, now_s: float, newest_s: float | None) -> bool:
        """Whether it is time to show the stall, again; `newest_s` is when the newest frame came, None before any."""
        if newest_s is None:
            return False
        self.came(newest_s)
        if now_s - newest_s < STALLED_AFTER_S:
            return False
        if self._since_s is None:
            self._since_s, self.stalls, self._told_s = newest_s, self.stalls + 1, now_s
            self._on_stall(STALLED, True)
            return True
        if due := now_s - self._told_s >= STALLED_AFTER_S:
            self._told_s = now_s
        return due

    def came(self, newest_s: float) -> None:
        """A stall ends with a frame that came after it began."""
        if self._since_s is not None and newest_s > self._since_s:
            self.close(newest_s)
            self._on_stall(STALLED, False)

    def close(self, now_s: float) -> None:
        """The run ends: a stall under way ends with it, and nothing is told."""
        if self._since_s is not None:
            self.stalled_s += now_s - self._since_s
            self._since_s = None
