"""Time as an argument."""

import time
from threading import Event
from typing import Protocol


class Clock(Protocol):
    """What time it is, and waiting."""

    def now(self) -> float:
        """Seconds since 1970; never goes back."""
        ...

    def wait(self, stop: Event, seconds: float) -> bool:
        """Wait that long, or until `stop` is set; whether it is."""
        ...


class WallClock:
    """The host's time of day when made, kept steady from then on."""

    def __init__(self) -> None:
        self._zero_s = time.time() - time.monotonic()

    def now(self) -> float:
        return self._zero_s + time.monotonic()

    def wait(self, stop: Event, seconds: float) -> bool:
        return stop.wait(max(seconds, 0.0))
