"""What the streaming loop asks of a viewer, and the viewer that shows nothing.

A slot between threads that keeps the newest value only.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Condition
from typing import Generic, Protocol, Self, TypeVar

from nlos_cam.frames import Frame, LidarMaps
from nlos_cam.reconstruct import PhysicsCheckResult, Reconstruction, Verdict


@dataclass(frozen=True)
class Moment:
    """One frame and what came of it."""

    frame: Frame
    reconstruction: Reconstruction
    published_s: float
    """The loop's clock when the reconstruction was ready."""
    latency_s: float
    """From the frame's timestamp to `published_s`, on one clock."""
    difference: LidarMaps | None = None
    """The maps less the bare wall's; None without a reference."""
    warnings: tuple[str, ...] = ()
    """What the person at the bench should know now, such as that the lidar has moved."""
    verdict: Verdict | None = None
    """None from networks that do not tell."""
    check: PhysicsCheckResult | None = None
    """The newest physics check, of this frame or an earlier one; None until there is one."""
    stages_s: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds by stage."""
    dropped: int = 0
    """Frames lost up to now, whoever lost them."""
    celsius: Mapping[str, float] = field(default_factory=dict[str, float])
    """The device's last temperatures, by name; empty where none were read."""


class Viewer(Protocol):
    """Shows the newest moment. `show` returns at once: a viewer may skip moments, and never slows the loop."""

    @property
    def address(self) -> str | None:
        """Where a browser finds it."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def show(self, moment: Moment) -> None: ...


class NullViewer:
    """A viewer for runs that nobody watches."""

    address: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def show(self, moment: Moment) -> None:
        pass


class Viewers:
    """Several viewers as one: each sees every moment."""

    def __init__(self, viewers: Sequence[Viewer]) -> None:
        self._viewers = viewers
        self._entered = ExitStack()

    @property
    def address(self) -> str | None:
        """The first that there is."""
        return next((viewer.address for viewer in self._viewers if viewer.address), None)

    def __enter__(self) -> Self:
        with ExitStack() as entered:
            for viewer in self._viewers:
                entered.enter_context(viewer)
            self._entered = entered.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._entered.close()

    def show(self, moment: Moment) -> None:
        for viewer in self._viewers:
            viewer.show(moment)


T = TypeVar("T")


class Latest(Generic[T]):
    """A slow reader skips values; the writer never waits for one. Any number of readers may watch."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._value: T | None = None
        self._count = 0
        self._closed = False

    @property
    def closed(self) -> bool:
        return self._closed

    def put(self, value: T) -> None:
        with self._changed:
            self._value, self._count = value, self._count + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Wake every reader; there will be no more values."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def after(self, count: int, timeout_s: float) -> tuple[int, T] | None:
        """The newest value and its count, once that is more than `count`; None if closed or nothing came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._count > count, timeout_s)
            if self._closed or self._count <= count or self._value is None:
                return None
            return self._count, self._value

    def fresh(self, count: int, patience_s: float, timeout_s: float) -> tuple[int, T] | None:
        """As `after`, but what is there already is passed over for the next one, if that comes within `patience_s`."""
        with self._changed:
            there = self._count
            if there > count:
                self._changed.wait_for(lambda: self._closed or self._count > there, patience_s)
        return self.after(count, timeout_s)
