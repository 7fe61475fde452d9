"""Protocol of viewers, the moment they show, and the viewer that shows nothing."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

from nlos_cam.frames import Frame, LidarMaps
from nlos_cam.reconstruct import PhysicsCheckResult, Reconstruction, Verdict


@dataclass(frozen=True)
class Moment:
    """One frame and its result."""

    frame: Frame
    reconstruction: Reconstruction
    published_s: float
    """The loop's clock when the reconstruction was ready."""
    latency_s: float
    """From the frame's timestamp to `published_s`, on one clock."""
    difference: LidarMaps | None = None
    """Maps minus the bare wall's; None without a reference."""
    warnings: tuple[str, ...] = ()
    """Warnings about the bench, such as that the lidar has moved."""
    verdict: Verdict | None = None
    """None without an uncertainty network."""
    check: PhysicsCheckResult | None = None
    """The newest physics check, of this frame or an earlier one; None until there is one."""
    stages_s: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds by stage."""
    dropped: int = 0
    """Frames lost so far."""
    celsius: Mapping[str, float] = field(default_factory=dict[str, float])
    """The device's last temperatures, by name; empty where none were read."""


class Controls(Protocol):
    """Status and commands of a run, for a page; both may be called from any thread."""

    def status(self) -> Mapping[str, Any]:
        """Return what the page shows beside the pictures, ready for JSON; `state` at least."""
        ...

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Run a command and return its outcome in words. Raises NlosCamError with the reason."""
        ...


class Viewer(Protocol):
    """Viewer of the newest moment. `show` returns at once: a viewer may skip moments and never
    slows the loop.
    """

    @property
    def address(self) -> str | None:
        """URL of the view; None without one."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def show(self, moment: Moment) -> None: ...


class Viewers:
    """Several viewers as one."""

    def __init__(self, viewers: Sequence[Viewer] = ()) -> None:
        self._viewers = viewers
        self._entered = ExitStack()

    @property
    def address(self) -> str | None:
        """URL of the first viewer that has one."""
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


class NullViewer(Viewers):
    """Viewer that shows nothing."""

    def begin(self, *_: object) -> None:
        """Do nothing."""
