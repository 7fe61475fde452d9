"""The seam that every camera is seen through. Everything above it is ignorant of librealsense.

Time as an argument.
"""

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from threading import Event
from typing import Protocol, Self

from nlos_calibration import Intrinsics, Rig

from nlos_cam.frames import Frame


class Camera(Protocol):
    """A source of Frames in SI units. Entering starts it; leaving stops it, whatever happened inside.

    Leaving ends an iteration, by whichever thread; doing so again does nothing. Iterating yields frames until the
    source ends: a recording's end is a normal end, a live camera goes on. Frames that lack a stream are counted in
    `incomplete` and skipped; frame numbers that never came are counted in `dropped`. Numbers and timestamps rise
    together, 30 a second, also over an outage after which the device counts anew: its numbers count as dropped.
    """

    uri: str
    intrinsics: Intrinsics
    rig: Rig | None
    """The bench, where the camera knows it (a simulated one does)."""
    identity: Mapping[str, str]
    """Of the device: name, serial, firmware, usb_type; without what it does not tell."""
    incomplete: int
    dropped: int
    counts: Counter[str]
    """What else befell it, by name, never zero: restarted, reset, replugged, and what `Pairing.counts` tells."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def __iter__(self) -> Iterator[Frame]: ...

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        """The options that can be read now, temperatures among them, by the SDK's name; empty where there are none.

        Each costs a real device a command on its link: ask for what is needed by the `ending` of its name.
        """
        ...


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
