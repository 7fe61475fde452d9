"""Protocol of viewers, the moment they show, and the viewer that shows nothing."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from nlos_calibration import is_temperature

from nlos_cam.reconstruct import FrameResult


@dataclass(frozen=True)
class Moment:
    """Result of one frame at the time at which it is shown."""

    result: FrameResult
    time_s: float
    """When the result was ready, by the loop's clock; of a recorded frame its timestamp."""
    latency_s: float
    """From the frame's timestamp to `time_s`, on one clock; of a recorded frame the sum of its
    stages.
    """
    dropped: int = 0
    """Frames lost so far."""
    celsius: Mapping[str, float] = field(default_factory=dict[str, float])
    """The device's last temperatures, by name; empty where none were read."""

    @property
    def known_celsius(self) -> dict[str, float]:
        """Temperatures, without readings that are none, as a recording may have them."""
        return {name: value for name, value in self.celsius.items() if is_temperature(value)}

    @classmethod
    def recorded(cls, result: FrameResult, celsius: Mapping[str, float] | None = None) -> Self:
        """Return the moment of a recorded frame."""
        stages_s = {name: took_s for name, took_s in result.stages_s.items() if name != "wait"}
        return cls(result, result.timestamp_s, sum(stages_s.values()), celsius=celsius or {})


SLACK_S = 0.01
"""Frames come at 30 per second: of a schedule of 0.1 s every third is due, and not every fourth
because of a thousandth.
"""


class Schedule:
    """Times a period apart by the moments' own clock; begins anew where that clock falls back."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last_s = float("-inf")
        self._due_s = float("-inf")

    def is_due(self, time_s: float) -> bool:
        """Return True for the first moment after each period; give it every moment, in order."""
        fell_back = time_s < self._last_s
        self._last_s = time_s
        if time_s < self._due_s and not fell_back:
            return False
        self._due_s = time_s + self._period_s - SLACK_S
        return True


class Controls(Protocol):
    """Status and commands of a run, for a page; both may be called from any thread."""

    def status(self) -> Mapping[str, Any]:
        """Return what the page shows beside the pictures, ready for JSON; `state` at least."""
        ...

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Run a command and return its outcome in words. Raises NlosCamError with the reason."""
        ...

    def file(self, name: str) -> Path | None:
        """Return the path of a file that a command wrote, by its name; None for any other."""
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
