"""What may be believed of a frame's reconstruction, in plain words, and by which rule it is said."""

from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from nlos_cam.frames import MAX_SATURATED, Frame, saturated_share
from nlos_cam.reconstruct.network import Reconstruction
from nlos_cam.reconstruct.physics_check import PhysicsCheckResult

STEADY_FRAMES = 5
"""Doubt about the range is averaged over so many frames (0.17 s), so that the verdict does not flicker."""


class Verdict(StrEnum):
    """One of six for each frame; where several hold, the one that comes last here is told.

    SEEN: something is there, like what the networks were trained on. NOTHING: the maps are those of the bench without
    anything hidden; no surface is shown, whatever is told. OUTSIDE: what is there is shown, but not to be believed: it
    is unlike the training set, or rendered again it does not explain the maps, or there is no surface to show, or half
    of the frame is missing. SATURATED, WALL_MOVED: of what the lidar saw, whatever was made of it. STALLED: the frame
    is old.
    """

    SEEN = "object seen"
    NOTHING = "nothing there"
    OUTSIDE = "outside the trained range"
    SATURATED = "saturated"
    WALL_MOVED = "wall moved"
    STALLED = "camera stalled"


@dataclass(frozen=True)
class VerdictLimits:
    """From which probabilities on it is told; they come with a doubt network."""

    nothing: float
    outside: float
    unexplained: float = float("inf")
    """Of the physics check's score: from there on the maps are not explained by what is shown."""


@dataclass(frozen=True)
class FrameConditions:
    """What else is known of a frame."""

    saturated: bool = False
    invalid: bool = False
    """At least half of the pixels have no depth."""
    moved: bool = False
    check: PhysicsCheckResult | None = None


class VerdictFilter:
    """Passes a verdict on each frame, in their order.

    Whether nothing is there is a matter of the frame alone: a shown object is gone with the first frame without it.
    """

    def __init__(self, limits: VerdictLimits | None) -> None:
        """None, where there is no doubt network: then only what the lidar saw is judged."""
        self._limits = limits
        self._outside: deque[float] = deque(maxlen=STEADY_FRAMES)

    def look(self, found: Reconstruction, signs: FrameConditions) -> tuple[Reconstruction, Verdict | None]:
        """The reconstruction as it is to be shown, and the verdict; None where there is no telling."""
        told = Verdict.WALL_MOVED if signs.moved else Verdict.SATURATED if signs.saturated else None
        if (limits := self._limits) is None or (doubt := found.doubt) is None:
            return found, told
        if doubt.nothing >= limits.nothing:
            self._outside.clear()
            return found.hidden, told or (Verdict.OUTSIDE if signs.invalid else Verdict.NOTHING)
        self._outside.append(doubt.outside)
        unlike = sum(self._outside) / len(self._outside) >= limits.outside
        unexplained = signs.check is not None and signs.check.score >= limits.unexplained
        outside = unlike or unexplained or signs.invalid or not found.shows
        return found, told or (Verdict.OUTSIDE if outside else Verdict.SEEN)


def frame_issues(frame: Frame) -> list[str]:
    """By name: blank (no depth at all), else half_invalid (for half the pixels or more); and saturated."""
    pixels, with_depth = frame.depth_m.size, np.count_nonzero(frame.depth_m > 0)  # NaN is not
    names: list[str] = []
    if with_depth == 0:
        names.append("blank")
    elif 2 * with_depth <= pixels:
        names.append("half_invalid")
    if saturated_share(frame.ir) > MAX_SATURATED:
        names.append("saturated")
    return names
