"""Verdict on a frame's reconstruction: one of six, with the rules that decide it."""

from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import MAX_SATURATED, Frame, saturated_share
from nlos_cam.reconstruct.consistency import COMPLETE, MapFindings
from nlos_cam.reconstruct.network import Reconstruction
from nlos_cam.reconstruct.physics_check import PhysicsCheckResult

FROZEN_AFTER = 4
"""Repeats of a frame after which a camera counts as frozen: a seventh of a second."""
STEADY_FRAMES = 5
"""Frames (0.17 s) over which the out-of-distribution probability is averaged, so that the verdict
does not flicker.
"""


class Verdict(StrEnum):
    """Reliability of one frame's reconstruction; if several verdicts hold, the last of them in this
    order is given.

    SEEN: there is an object like those of the training set.
    NOTHING: the bench is empty; no surface is shown.
    OUTSIDE: the picture, also an empty one, is not reliable. The object is out of distribution
    (OOD); or the physics check does not explain the maps by the picture; or the maps cannot be
    those of any object on this bench (`MapConsistency`); or half of the frame has no depth; or the
    bench does not look empty, and no surface was found.
    SATURATED, WALL_MOVED: the lidar's data are not usable, whatever was reconstructed.
    STALLED: no newer frame has come, or the same one again and again.
    """

    SEEN = "object seen"
    NOTHING = "nothing there"
    OUTSIDE = "outside the trained range"
    SATURATED = "saturated"
    WALL_MOVED = "wall moved"
    STALLED = "camera stalled"


@dataclass(frozen=True)
class VerdictLimits:
    """Smallest values at which a verdict is given.

    The first two are quantiles over the uncertainty model's held-out samples, set when it was
    trained (`nlos_models.training.uncertainty.calibrate`), the third over rendered objects.
    """

    nothing: float
    """Probability that nothing is hidden: 999 of 1,000 empty benches reach it; at most 0.5."""
    outside: float
    """Probability that the object is out of distribution. At this limit 15 % of ordinary objects
    count as such, and nine in ten of those that are.
    """
    unexplained: float = float("inf")
    """Score of the physics check; see UNEXPLAINED."""
    unexplained_empty: float = float("inf")
    """The same where no surface is shown; see UNEXPLAINED_EMPTY."""


@dataclass(frozen=True)
class FrameConditions:
    """Conditions of frame and bench that affect the verdict."""

    saturated: bool = False
    invalid: bool = False
    """At least half of the pixels have no depth."""
    moved: bool = False
    frozen: bool = False
    """The camera repeats one frame."""
    findings: MapFindings = COMPLETE
    check: PhysicsCheckResult | None = None
    """A recent one; None where the newest is old."""

    @property
    def contradicted(self) -> bool:
        """True if the maps alone forbid any good word, whatever the networks say."""
        return self.invalid or bool(self.findings.problems)


class FrozenFrames:
    """Watch for a camera that repeats a frame. Stateful: give it the frames in order.

    The noise of a lidar differs from frame to frame, so that two equal ones are already a fault. A
    few are waited for, and frames without noise, of a simulation, say nothing.
    """

    def __init__(self) -> None:
        self._last: Frame | None = None
        self._repeats = 0

    def add(self, frame: Frame) -> bool:
        """Return True if this frame and those before it are the same."""
        last = self._last
        self._last = frame
        same = (
            last is not None
            and np.array_equal(last.ir, frame.ir)
            and np.array_equal(last.depth_m, frame.depth_m, equal_nan=True)
        )
        self._repeats = self._repeats + 1 if same else 0
        return self._repeats >= FROZEN_AFTER and is_noisy(frame.ir)


def is_noisy(ir: NDArray[np.uint8]) -> bool:
    """Return True for an infrared image whose neighboring pixels differ by noise: by the second
    difference along a row, which a smooth image does not have.
    """
    row = ir.astype(np.int16)
    bent = np.abs(row[:, :-2] - 2 * row[:, 1:-1] + row[:, 2:])
    return bool(np.median(bent) >= 1)


class VerdictFilter:
    """Decision of each frame's verdict. Stateful: give it the frames in order, from one thread.

    The out-of-distribution probability is averaged over frames. That nothing is hidden is decided
    for each frame alone, so an object that leaves disappears with the first frame without it.
    Without `limits` (no uncertainty model) only the conditions of lidar and bench are considered.
    """

    def __init__(self, limits: VerdictLimits | None) -> None:
        self._limits = limits
        self._outside: deque[float] = deque(maxlen=STEADY_FRAMES)

    def shown(self, reconstruction: Reconstruction) -> Reconstruction:
        """Return the reconstruction to show: without surface if nothing is hidden, as decided on
        this frame alone.
        """
        return reconstruction.without_surface if self._is_empty(reconstruction) else reconstruction

    def _is_empty(self, reconstruction: Reconstruction) -> bool:
        """Return True if the networks say that nothing is hidden."""
        limits = self._limits
        uncertainty = reconstruction.uncertainty
        if limits is None or uncertainty is None:
            return False
        return uncertainty.p_empty >= limits.nothing

    def decide(
        self, reconstruction: Reconstruction, conditions: FrameConditions
    ) -> tuple[Reconstruction, Verdict | None]:
        """Return the reconstruction to show (`shown`) and the verdict."""
        # Whatever was reconstructed from data that are not usable is not usable either: these two
        # go before the verdict of the networks.
        of_lidar = None
        if conditions.saturated:
            of_lidar = Verdict.SATURATED
        if conditions.moved:
            of_lidar = Verdict.WALL_MOVED
        if conditions.frozen:
            of_lidar = Verdict.STALLED

        limits = self._limits
        uncertainty = reconstruction.uncertainty
        if limits is None or uncertainty is None:
            return reconstruction, of_lidar

        if self._is_empty(reconstruction):
            # Decided on this frame alone; a new object must not be averaged with the one that left.
            self._outside.clear()
            unlike_empty = self._is_unexplained(conditions, limits.unexplained_empty, shown=False)
            wrong = conditions.contradicted or unlike_empty
            verdict = Verdict.OUTSIDE if wrong else Verdict.NOTHING
            return self.shown(reconstruction), of_lidar or verdict

        # "Outside" needs a mean over frames: noise moves the probability across the limit.
        self._outside.append(uncertainty.p_out_of_distribution)
        unlike = sum(self._outside) / len(self._outside) >= limits.outside
        unexplained = self._is_unexplained(conditions, limits.unexplained, shown=True)
        wrong = conditions.contradicted or unlike or unexplained or not reconstruction.has_surface
        return reconstruction, of_lidar or (Verdict.OUTSIDE if wrong else Verdict.SEEN)

    @staticmethod
    def _is_unexplained(conditions: FrameConditions, limit: float, *, shown: bool) -> bool:
        """Return True if the check did not explain the maps, with a score of at least `limit`.

        A recent check counts only for pictures of its own kind: with a surface if `shown`, else of
        an empty bench.
        """
        check = conditions.check
        return check is not None and check.has_surface == shown and check.score >= limit


def frame_issues(frame: Frame) -> tuple[str, ...]:
    """Return the issues of a frame: blank (no depth at all) or half_invalid (none in half of the
    pixels); saturated.
    """
    with_depth = np.count_nonzero(frame.depth_m > 0)  # NaN (no return) compares false
    issues: list[str] = []
    if with_depth == 0:
        issues.append("blank")
    elif 2 * with_depth <= frame.depth_m.size:
        issues.append("half_invalid")
    if saturated_share(frame.ir) > MAX_SATURATED:
        issues.append("saturated")
    return tuple(issues)
