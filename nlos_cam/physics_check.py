"""A reconstruction rendered again, and held against what the lidar saw: what is found, and who looks."""

import logging
from dataclasses import dataclass
from typing import Protocol, Self

from nlos_calibration.arrays import Float32

from nlos_cam.frames import LidarMaps

UNEXPLAINED = 0.91
"""The score from which on what is shown does not explain the maps: 1 % of the 300 new objects that it was chosen on
reach it (docs/physics-check.md)."""

log = logging.getLogger(__name__)


def log_warning(text: str) -> None:
    """Tell of a check that failed where nobody else is told."""
    log.warning("%s", text)


def failure(frame_number: int, what: str) -> str:
    """A check that failed, in a line."""
    return f"the physics check of frame {frame_number} failed ({what}): frames go on without"


@dataclass(frozen=True)
class Check:
    """What one frame's check found."""

    frame_number: int
    residual_depth_m: Float32
    """(64, 80): seen less rendered; NaN where either has no return."""
    residual_intensity: Float32
    """(64, 80): seen less rendered, in IR counts."""
    score: float
    """0 where the maps are explained to within the sensor's noise; 1 where they are explained no better than by nothing
    at all hidden; more where worse."""
    seconds: float
    """How long it took."""
    albedo: float = 1.0
    """Of the object, against what the networks were trained on: the one that explains the maps best."""


class Checks(Protocol):
    """Checks some of the frames that it is shown, beside the loop or in its midst, while it is entered."""

    newest: Check | None
    """None until there is one."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Show it a frame's maps and the hidden depth (64, 64) made of them."""
        ...


class NoChecks:
    """For loops that nothing is checked of."""

    newest: Check | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        pass
