"""Protocols that every camera and its clock fulfil; nothing above them knows librealsense."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from threading import Event
from typing import Protocol, Self

from nlos_calibration import Intrinsics, Rig

from nlos_cam.frames import Frame

SIMULATED_SERIAL = "simulated"
"""Serial number of every simulated camera."""
OnProgress = Callable[[int, int], None]
"""Called with the poses rendered so far and in all, while a simulated world is pre-rendered."""


class Camera(Protocol):
    """Source of Frames in SI units, started on entering and stopped on leaving, whatever happened
    inside.

    Any thread may leave, which ends an iteration; leaving again has no effect. Iterating yields
    frames until the source ends: a recording's end is a normal end, a live camera goes on. Frames
    without all streams are counted in `incomplete` and skipped; missing frame numbers are counted
    in `dropped`. Numbers and timestamps rise together, 30 a second, also over an outage after which
    the device restarts its count: the outage's numbers count as dropped.
    """

    uri: str
    intrinsics: Intrinsics
    rig: Rig | None
    """Rig geometry, where the camera knows it (a simulated one does)."""
    identity: Mapping[str, str]
    """Name, serial, firmware and usb_type of the device, as far as it reports them."""
    incomplete: int
    dropped: int
    counts: Counter[str]
    """Other events by name, never zero: restarted, reset, replugged, and those of
    `FrameSynchronizer.counts`.
    """

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def __iter__(self) -> Iterator[Frame]: ...

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        """Return the options that can be read now, temperatures among them, by the SDK's name;
        empty without any.

        Each costs a real device a command on its link: limit them by the `ending` of their names.
        """
        ...


class WaitingClock(Protocol):
    """Time source that can also wait."""

    def now(self) -> float:
        """Return seconds since 1970; never goes back."""
        ...

    def wait(self, stop: Event, seconds: float) -> bool:
        """Wait for this time, or until `stop` is set; return True if it is."""
        ...


class WallClock:
    """The host's time of day at construction, advanced by its monotonic clock."""

    def __init__(self) -> None:
        self._zero_s = time.time() - time.monotonic()

    def now(self) -> float:
        return self._zero_s + time.monotonic()

    def wait(self, stop: Event, seconds: float) -> bool:
        return stop.wait(max(seconds, 0.0))
