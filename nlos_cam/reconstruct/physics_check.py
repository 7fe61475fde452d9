"""A reconstruction rendered again, and held against what the lidar saw: what is found, and who looks.

How far the echoes that a renderer expects explain the maps that a lidar gave: arrays in, a score out.

Each cell tells one echo of two, the strongest (S5): the bare wall's own, or that of three bounces. Where both are about
as strong, a small error of the object swaps them and moves the depth by decimetres. So both are held against what was
seen, and the one that explains it better counts. With r = seen less expected and s a tolerance that holds the noise:

    h = (depth r / s)^2 + (log intensity r / s)^2 + (log of how much the other echo is stronger / s)^2
    cost = h / (1 + h)                          0 explained, 1 not at all; and the mean of it over the cells
    score = (cost - NOISE_COST) / (cost of the bare bench - NOISE_COST), the one above at least 0, the one below at
            least MIN_UNEXPLAINED

Two things are not known beforehand and fitted: the device's gain, from the cells that show the bare wall, and the
object's albedo, to within a factor of MAX_ALBEDO, as the one of the least cost. A wider range of albedos would explain
any object that is not there as a dark one.

The physics check itself: a reconstruction rendered again, through the expected sensor, against the lidar's maps.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, Self

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, SATURATED, LidarMaps
from nlos_cam.reconstruct.network import Clock
from nlos_cam.render import Rendering, Scene, SensorModel, Stop, cast, render

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
class PhysicsCheckResult:
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


class PhysicsCheck(Protocol):
    """PhysicsCheck some of the frames that it is shown, beside the loop or in its midst, while it is entered."""

    newest: PhysicsCheckResult | None
    """None until there is one."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Show it a frame's maps and the hidden depth (64, 64) made of them."""
        ...


class NullPhysicsCheck:
    """For loops that nothing is checked of."""

    newest: PhysicsCheckResult | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        pass


WALL_TOLERANCE_M = 0.003
"""Of the bare wall's depth: what a bench's record leaves."""
ECHO_TOLERANCE_M = 0.01
"""Of a three-bounce echo's depth: two bins, and the least that reconstructions err by."""
LOG_TOLERANCE = 0.6
"""Of an intensity's logarithm, a factor of 1.8: what distance and slope of a reconstruction err by."""
MAX_ALBEDO, ALBEDOS = 4 / 3, 5
NOISE_COST = 0.006
"""What the sensor's noise, and cells of many pixels, leave of a bare bench that is explained."""
MIN_UNEXPLAINED = 0.02
"""With less than this left by a bare bench nothing is to be explained. Objects leave 0.14 or more."""
FEWEST_BARE = 50
"""Cells that show the bare wall, for them to tell the gain."""
NOISE = SensorModel()


@dataclass(frozen=True)
class Expected:
    """What would come back from each cell (64, 80): depths along the optical axis, intensities in units of I0."""

    direct_m: Float64
    """NaN where nothing returns."""
    direct: Float64
    echo_m: Float64
    """Of three bounces; NaN where there is none."""
    echo: Float64

    @property
    def bare(self) -> "Expected":
        """The same without three bounces."""
        return Expected(self.direct_m, self.direct, np.full_like(self.echo_m, np.nan), np.zeros_like(self.echo))

    def seen(self, albedo: float, gain: float) -> tuple[Float32, Float32]:
        """Depth, NaN where there is no return, and intensity in counts, as a lidar without noise would give them."""
        wins = albedo * self.echo > self.direct
        intensity = np.where(wins, albedo * self.echo, self.direct)
        depth_m = np.where(intensity > 0, np.where(wins, self.echo_m, self.direct_m), np.nan)
        return depth_m.astype(np.float32), np.minimum(gain * intensity, SATURATED).astype(np.float32)


@dataclass(frozen=True)
class Explanation:
    """How the maps are explained best."""

    score: float
    albedo: float
    gain: float
    """Counts for an intensity of I0."""


def explanation(seen: LidarMaps, expected: Expected, bare: Expected) -> Explanation:
    """The best explanation of maps by an object, against that of the bare bench."""
    gain = fitted_gain(seen, bare)
    albedos = np.geomspace(1 / MAX_ALBEDO, MAX_ALBEDO, ALBEDOS) if (expected.echo > 0).any() else np.ones(1)
    costs = [mean_cost(seen, expected, gain, albedo) for albedo in albedos]
    best = int(np.argmin(costs))
    unexplained = max(mean_cost(seen, bare, gain, 1.0) - NOISE_COST, MIN_UNEXPLAINED)
    return Explanation(max(costs[best] - NOISE_COST, 0.0) / unexplained, float(albedos[best]), gain)


def fitted_gain(seen: LidarMaps, bare: Expected) -> float:
    """Counts for an intensity of I0, by the median of the cells that show the bare wall; of all, if these are few."""
    told = seen.valid & (seen.intensity > 0) & (bare.direct > 0)
    shows_wall = told & (np.abs(seen.depth_m - bare.direct_m) < 3 * WALL_TOLERANCE_M)
    some = shows_wall if shows_wall.sum() >= FEWEST_BARE else told
    return float(np.median(seen.intensity[some] / bare.direct[some])) if some.any() else 1.0


def mean_cost(seen: LidarMaps, expected: Expected, gain: float, albedo: float) -> float:
    """The mean, over cells that return or should, of how far they are not explained: 0 to 1."""
    echo = albedo * expected.echo
    should = (expected.direct > 0) | (echo > 0)
    seen_m, light = np.where(seen.valid, seen.depth_m, np.nan).astype(np.float64), _light(seen, gain)
    counts_of_i0 = NOISE.bare_wall_counts / max(float(expected.direct.max()), 1e-12)
    lead, most = _log(echo) - _log(expected.direct), np.log(SATURATED / gain)
    wall = _distance((seen_m - expected.direct_m) / WALL_TOLERANCE_M, light, expected.direct, counts_of_i0, lead, most)
    bounced = _distance((seen_m - expected.echo_m) / ECHO_TOLERANCE_M, light, echo, counts_of_i0, -lead, most)
    nearer = np.minimum(wall, bounced)
    cost = np.where(np.isfinite(nearer), nearer / (1 + np.where(np.isfinite(nearer), nearer, 0)), 1.0)
    counts = seen.valid | should
    return float(cost[counts].mean()) if counts.any() else 0.0


def _distance(
    off: Float64, light: Float64, expected: Float64, counts_of_i0: float, lead: Float64, most: float
) -> Float64:
    """What `h` is of one of the two echoes; infinite where it is none, or nothing was seen.

    `off` is the depth's part of it, `lead` the log of how much the other is stronger; from a log light of `most` on the
    lidar is saturated, and what was there may have been stronger.
    """
    counts = counts_of_i0 * expected
    with np.errstate(divide="ignore", invalid="ignore"):
        spread2 = LOG_TOLERANCE**2 + (NOISE.read_noise_counts**2 + NOISE.shot_noise**2 * counts) / counts**2
        apart = light - _log(expected)
        apart = np.where(light >= most, np.maximum(apart, 0), apart)
        h = off**2 + apart**2 / spread2 + (np.maximum(lead, 0) / LOG_TOLERANCE) ** 2
    return np.where((expected > 0) & np.isfinite(h), h, np.inf)


def _light(seen: LidarMaps, gain: float) -> Float64:
    """The logarithm of what was seen, in units of I0."""
    return _log(seen.intensity.astype(np.float64) / gain)


def _log(intensity: Float64) -> Float64:
    """The logarithm; of nothing, that of next to nothing."""
    return np.log(np.maximum(intensity, 1e-12))


CHECKED_FRAMES = 30
"""Of a replay, every so many frames are checked: about once a second."""


def check(
    maps: LidarMaps,
    depth_m: Float32 | None,
    rig: Rig,
    *,
    frame_number: int = 0,
    accuracy: Stop = "standard",
    clock: Clock = time.perf_counter,
) -> PhysicsCheckResult:
    """Render a hidden depth (64, 64) again, and hold what a lidar would see of it against the maps that it gave.

    Without any surface, and on a rig without an object box, the bare bench is held against them. The depth of the maps
    is that of the rig: what the lidar is known to lack was added (`Bench.corrected`).
    """
    start_s = clock()
    bare = _bare(rig)  # pyright: ignore[reportArgumentType]  frozen, so hashable
    hides = depth_m is not None and rig.object_box is not None and bool(np.isfinite(depth_m).any())
    expected = _expected(render(Scene(rig, depth_m), accuracy), rig, bare) if hides else bare
    best = explanation(maps, expected, bare)
    rendered_m, rendered = expected.seen(best.albedo, best.gain)
    seen_m = np.where(maps.valid, maps.depth_m, np.float32(np.nan))
    residuals = seen_m - rendered_m, maps.intensity - rendered
    return PhysicsCheckResult(frame_number, *residuals, best.score, clock() - start_s, best.albedo)


@lru_cache(maxsize=4)
def _bare(rig: Rig) -> Expected:
    """What comes back with nothing hidden."""
    return _expected(render(Scene(rig)), rig, None)


def _expected(rendering: Rendering, rig: Rig, bare: Expected | None) -> Expected:
    """Both echoes of each cell; where three bounces won, the direct one is the bare bench's."""
    cos_axis = cast(rig, rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)).cos_axis.reshape(MAP_ROWS, MAP_COLUMNS)
    echo, echo_m = rendering.multi.peak.astype(np.float64), rendering.multi.path_m / 2 * cos_axis
    direct, direct_m = rendering.intensity.astype(np.float64), rendering.depth_m.astype(np.float64)
    if bare is None:
        return Expected(direct_m, direct, echo_m, echo)
    bounced = (rendering.intensity <= rendering.multi.peak) & (echo > 0)
    return Expected(np.where(bounced, bare.direct_m, direct_m), np.where(bounced, bare.direct, direct), echo_m, echo)


class EveryFrames:
    """PhysicsCheck every so many frames on the spot: of the same frames always the same ones, to the bit.

    `on_error` hears of the first check that fails.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        every: int = CHECKED_FRAMES,
        accuracy: Stop = "standard",
        on_error: Callable[[str], None] = log_warning,
    ) -> None:
        self.newest: PhysicsCheckResult | None = None
        self._rig, self._every, self._offered = rig, every, 0
        self._accuracy: Stop = accuracy
        self._on_error, self._said = on_error, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """PhysicsCheckResult this frame if it is one of those."""
        self._offered += 1
        if (self._offered - 1) % self._every:
            return
        try:
            self.newest = check(maps, depth_m, self._rig, frame_number=frame_number, accuracy=self._accuracy)
        except Exception as error:  # noqa: BLE001  whatever it was, frames go on without
            if not self._said:
                self._on_error(failure(frame_number, f"{type(error).__name__}: {error}"))
            self._said = True
