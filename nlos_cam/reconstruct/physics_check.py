"""Physics check: a reconstruction rendered again and compared with the lidar's maps.

Each cell returns one of two echoes, the stronger one (S5): that of the bare wall, or that of three
bounces. If both are about as strong, a small error of the object swaps them and changes the depth
by decimetres. So the measurement is compared with both, and the one that explains it better counts.
With r = measured less expected and s a tolerance that covers the noise:

    h     = (depth r / s)^2 + (log intensity r / s)^2
            + (log of how much the other echo is stronger / s)^2
    cost  = h / (1 + h)         0 explained, 1 not at all; averaged over the cells on the wall
    score = (cost - noise) / (cost of the bare bench - noise)

The numerator is at least 0, the denominator at least MIN_UNEXPLAINED. The noise is the cost of an
empty bench on this rig (`noise_cost`): where a lidar faces the wall at a slant, its cells are large.

The occluder's cells take no part: nothing tells how much it reflects, and no object changes them.

Two unknowns are fitted: the device's gain, from the cells that show the bare wall, and the object's
albedo, to within a factor of MAX_ALBEDO, as the one of least cost. A wider range of albedos would
explain any missing object as a dark one.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Protocol, Self

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64, Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, SATURATED, LidarMaps, maps_from_frame
from nlos_cam.reconstruct.bare_bench import bare_rendering, brightest_light, cells_on_wall
from nlos_cam.reconstruct.network import Clock
from nlos_cam.render import Rendering, Scene, Sensor, SensorModel, Stop, cast, render

UNEXPLAINED_EMPTY = 0.5
"""Score from which on the empty bench does not explain the maps. Empty benches score 0.00, and any
object that is missed about 1.
"""
UNEXPLAINED = 0.84
"""Score from which on the reconstruction does not explain the maps: 1 % of the 300 new objects that
it was chosen on reach it (docs/physics-check.md)."""

log = logging.getLogger(__name__)


def log_warning(text: str) -> None:
    """Log a failed check; the default of `on_error`."""
    log.warning("%s", text)


def describe_failure(frame_number: int, reason: str) -> str:
    """Return one line on a failed check."""
    return (
        f"the physics check of frame {frame_number} failed ({reason}): the run continues without it"
    )


@dataclass(frozen=True)
class PhysicsCheckResult:
    """Residuals and score of one frame's check."""

    frame_number: int
    residual_depth_m: Float32
    """(64, 80): measured less rendered; NaN where either has no return."""
    residual_intensity: Float32
    """(64, 80): measured less rendered, in IR counts."""
    score: float
    """0 if the maps are explained to within noise, 1 if no better than by an empty bench, more if
    worse.
    """
    seconds: float
    """Duration of the check."""
    albedo: float = 1.0
    """Albedo of the object that explains the maps best, relative to the training set's."""
    has_surface: bool = True
    """False if the empty bench was compared, because no surface was shown."""


class PhysicsCheck(Protocol):
    """Check of some of the frames offered to it, in the loop's thread or beside it, while
    entered.
    """

    newest: PhysicsCheckResult | None
    """None until there is one."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def use_rig(self, rig: Rig) -> None:
        """Compare the frames that are offered from now on with this rig, and forget what was found
        on another.
        """
        ...

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Offer a frame's maps and the hidden depth (64, 64) reconstructed from them."""
        ...


class NullPhysicsCheck:
    """Physics check that does nothing."""

    newest: PhysicsCheckResult | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def use_rig(self, rig: Rig) -> None:
        pass

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        pass


WALL_TOLERANCE_M = 0.003
"""Tolerance of the bare wall's depth: the error of a bench's record."""
ECHO_TOLERANCE_M = 0.01
"""Tolerance of a three-bounce echo's depth: two bins, and the smallest error of reconstructions."""
LOG_TOLERANCE = 0.6
"""Tolerance of an intensity's logarithm, a factor of 1.8: errors of a reconstruction's distance and
slope.
"""
MAX_ALBEDO = 4 / 3
ALBEDOS = 5
"""Factors of the training set's albedo that are tried, from 1 / MAX_ALBEDO to MAX_ALBEDO."""
NOISE_COST = 0.006
"""Smallest cost of an explained bare bench, that of the paper's rig: the sensor's noise, and cells
of many pixels."""
MIN_UNEXPLAINED = 0.02
"""Smallest denominator of the score, for benches without an object; objects cost a bare bench 0.14
or more.
"""
COUNTS_STEP = 0.2
MIN_BARE_CELLS = 50
"""Cells showing the bare wall that are needed to fit the gain to them alone."""
NOISE = SensorModel()


@dataclass(frozen=True)
class Expected:
    """Two expected echoes of each cell (64, 80): depths along the optical axis, intensities in
    units of I0.
    """

    direct_m: Float64
    """NaN where there is no return."""
    direct: Float64
    echo_m: Float64
    """Depth of the three-bounce echo; NaN where there is none."""
    echo: Float64
    sees_wall: Mask
    """Cells that see the wall alone, which are compared."""

    @property
    def bare(self) -> "Expected":
        """The same without three-bounce echoes."""
        return replace(
            self, echo_m=np.full_like(self.echo_m, np.nan), echo=np.zeros_like(self.echo)
        )

    def noiseless_maps(self, albedo: float, gain: float) -> tuple[Float32, Float32]:
        """Return depth (NaN where there is no return) and intensity in counts, as measured without
        noise.
        """
        # The lidar reports the stronger of two echoes (S5).
        wins = albedo * self.echo > self.direct
        intensity = np.where(wins, albedo * self.echo, self.direct)
        depth_m = np.where(wins, self.echo_m, self.direct_m)
        depth_m = np.where(intensity > 0, depth_m, np.nan)
        counts = np.minimum(gain * intensity, SATURATED)
        return depth_m.astype(np.float32), counts.astype(np.float32)


@dataclass(frozen=True)
class Explanation:
    """Best fit of the expected echoes to the maps."""

    score: float
    albedo: float
    gain: float
    """Counts for an intensity of I0."""


def explain(
    maps: LidarMaps, expected: Expected, bare: Expected, noise: float = NOISE_COST
) -> Explanation:
    """Return the best explanation of maps by an object, scored against that of the bare bench."""
    gain = fit_gain(maps, bare)
    albedos = np.ones(1)
    if (expected.echo > 0).any():
        albedos = np.geomspace(1 / MAX_ALBEDO, MAX_ALBEDO, ALBEDOS)
    costs = [mean_cost(maps, expected, gain, albedo) for albedo in albedos]
    best = int(np.argmin(costs))
    # Noise costs something on a perfect explanation too; an empty bench leaves nothing to explain,
    # and its score would be a ratio of two noises.
    unexplained = max(mean_cost(maps, bare, gain, 1.0) - noise, MIN_UNEXPLAINED)
    return Explanation(max(costs[best] - noise, 0.0) / unexplained, float(albedos[best]), gain)


def fit_gain(maps: LidarMaps, bare: Expected) -> float:
    """Return the counts for an intensity of I0: the median of the cells that show the bare wall, of
    all if too few.
    """
    # The median ignores the few cells in which an echo happens to lie at the wall's depth.
    lit = bare.sees_wall & maps.valid & (maps.intensity > 0) & (bare.direct > 0)
    shows_wall = lit & (np.abs(maps.depth_m - bare.direct_m) < 3 * WALL_TOLERANCE_M)
    cells = shows_wall if shows_wall.sum() >= MIN_BARE_CELLS else lit
    return float(np.median(maps.intensity[cells] / bare.direct[cells])) if cells.any() else 1.0


def mean_cost(maps: LidarMaps, expected: Expected, gain: float, albedo: float) -> float:
    """Return the mean cost, 0 to 1, over the cells on the wall with a measured or expected
    return.
    """
    echo = albedo * expected.echo
    measured_m = np.where(maps.valid, maps.depth_m, np.nan).astype(np.float64)
    log_light = _log(maps.intensity.astype(np.float64) / gain)  # in units of I0
    lead = _log(echo) - _log(expected.direct)
    sensor = Exposure(counts_of_i0=gain, log_full_scale=np.log(SATURATED / gain))

    # The lidar reports one of two echoes: the one that explains the cell better is taken.
    off_wall = (measured_m - expected.direct_m) / WALL_TOLERANCE_M
    off_echo = (measured_m - expected.echo_m) / ECHO_TOLERANCE_M
    wall = _misfit(off_wall, log_light, expected.direct, lead, sensor)
    bounced = _misfit(off_echo, log_light, echo, -lead, sensor)
    h = np.minimum(wall, bounced)

    # h / (1 + h) tends to 1 for h -> infinity, but inf / inf is NaN.
    cost = np.where(np.isfinite(h), h / (1 + np.where(np.isfinite(h), h, 0)), 1.0)
    # A cell without a return, where none is expected either, tells nothing.
    counted = expected.sees_wall & (maps.valid | (expected.direct > 0) | (echo > 0))
    return float(cost[counted].mean()) if counted.any() else 0.0


class Exposure(NamedTuple):
    """Scale of a frame's intensities."""

    counts_of_i0: float
    """Counts of an intensity of I0: noise is known in counts."""
    log_full_scale: float
    """Logarithm of the saturated intensity in units of I0."""


def _misfit(
    off: Float64, log_light: Float64, expected: Float64, lead: Float64, sensor: Exposure
) -> Float64:
    """Return `h` of one of the two echoes; infinite where there is none, or nothing was measured.

    `off` is the depth term's r / s, `log_light` the log of the measured intensity, `lead` the log
    of how much the other echo is stronger.
    """
    counts = sensor.counts_of_i0 * expected
    with np.errstate(divide="ignore", invalid="ignore"):
        # d(log n) = dn / n, so noise of variance read^2 + shot^2 n has variance
        # (read^2 + shot^2 n) / n^2 in log n.
        variance = (
            LOG_TOLERANCE**2
            + (NOISE.read_noise_counts**2 + NOISE.shot_noise**2 * counts) / counts**2
        )
        # A saturated cell measures a lower limit of its light: only too little expected light is
        # a misfit.
        log_ratio = log_light - _log(expected)
        is_saturated = log_light >= sensor.log_full_scale
        log_ratio = np.where(is_saturated, np.maximum(log_ratio, 0), log_ratio)
        # The weaker echo can be the reported one only by an error of the expected intensities.
        weaker = np.maximum(lead, 0) / LOG_TOLERANCE
        h = off**2 + log_ratio**2 / variance + weaker**2
    return np.where((expected > 0) & np.isfinite(h), h, np.inf)


def _log(intensity: Float64) -> Float64:
    """Return the natural logarithm, finite at zero."""
    return np.log(np.maximum(intensity, 1e-12))


CHECKED_FRAMES = 30
"""Frames from one check to the next in a replay: about a second."""


def check_reconstruction(
    maps: LidarMaps,
    depth_m: Float32 | None,
    rig: Rig,
    *,
    frame_number: int = 0,
    accuracy: Stop = "standard",
    clock: Clock = time.perf_counter,
) -> PhysicsCheckResult:
    """Render a hidden depth (64, 64) and compare the echoes with the lidar's maps.

    Without a surface or an object box the bare bench is compared. The maps' depths include the
    range offset (`CalibratedRig.correct_range`).
    """
    start_s = clock()
    nothing_hidden = bare_rendering(rig)  # pyright: ignore[reportArgumentType]  frozen, so hashable
    bare = _expected(nothing_hidden, rig, None)
    expected = bare
    shows_surface = depth_m is not None and bool(np.isfinite(depth_m).any())
    has_surface = shows_surface and rig.object_box is not None
    if has_surface:
        expected = _expected(render(Scene(rig, depth_m), accuracy), rig, bare)

    counts = fit_gain(maps, bare) * brightest_light(rig)
    # In steps of a fifth, so that few are computed.
    steps = round(np.log(max(counts, 1.0)) / COUNTS_STEP)
    noise = noise_cost(rig, float(np.exp(steps * COUNTS_STEP)))  # pyright: ignore[reportArgumentType]
    best = explain(maps, expected, bare, noise)
    rendered_m, rendered = expected.noiseless_maps(best.albedo, best.gain)
    measured_m = np.where(maps.valid, maps.depth_m, np.float32(np.nan))
    return PhysicsCheckResult(
        frame_number,
        residual_depth_m=measured_m - rendered_m,
        residual_intensity=maps.intensity - rendered,
        score=best.score,
        seconds=clock() - start_s,
        albedo=best.albedo,
        has_surface=has_surface,
    )


@lru_cache(maxsize=16)
def noise_cost(rig: Rig, counts: float) -> float:
    """Return the cost of an empty bench on a rig, as the simulated sensor sees it at a gain: the
    `counts` of the brightest return of its wall. NOISE_COST at least.
    """
    empty = bare_rendering(rig)  # pyright: ignore[reportArgumentType]
    sensor = NOISE.model_copy(update={"bare_wall_counts": counts})
    images = Sensor(rig, sensor).expose(empty.multi, np.random.default_rng(0))
    maps = maps_from_frame(images.frame(rig.pinhole))
    bare = _expected(empty, rig, None)
    return max(mean_cost(maps, bare, fit_gain(maps, bare), 1.0), NOISE_COST)


def _expected(rendering: Rendering, rig: Rig, bare: Expected | None) -> Expected:
    """Return both echoes of each cell; where three bounces won, the direct echo is the bare
    bench's.
    """
    shape = MAP_ROWS, MAP_COLUMNS
    cos_axis = cast(rig, rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)).cos_axis.reshape(shape)
    echo = rendering.multi.peak.astype(np.float64)
    echo_m = rendering.multi.path_m / 2 * cos_axis
    direct = rendering.intensity.astype(np.float64)
    direct_m = rendering.depth_m.astype(np.float64)
    if bare is None:
        return Expected(direct_m, direct, echo_m, echo, cells_on_wall(rig))

    # The rendering holds the stronger echo of each cell: where that has three bounces, the wall's
    # own is taken from the bare bench, which the object does not change.
    bounced = (rendering.intensity <= rendering.multi.peak) & (echo > 0)
    return Expected(
        direct_m=np.where(bounced, bare.direct_m, direct_m),
        direct=np.where(bounced, bare.direct, direct),
        echo_m=echo_m,
        echo=echo,
        sees_wall=bare.sees_wall,
    )


class PeriodicPhysicsCheck(NullPhysicsCheck):
    """Physics check of the first of every `every` frames, in the caller's thread: reproducible to
    the bit.

    Calls `on_error` for the first check that fails.
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
        self._rig = rig
        self._every = every
        self._offered = 0
        self._accuracy: Stop = accuracy
        self._on_error = on_error
        self._failed = False

    def use_rig(self, rig: Rig) -> None:
        """Compare the frames that are offered from now on with this rig."""
        if rig != self._rig:
            self.newest = None
        self._rig = rig

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Check this frame if it is the first of its group."""
        is_due = self._offered % self._every == 0
        self._offered += 1
        if not is_due:
            return
        try:
            self.newest = check_reconstruction(
                maps, depth_m, self._rig, frame_number=frame_number, accuracy=self._accuracy
            )
        except Exception as error:  # noqa: BLE001  whatever it was, the run continues without this check
            if not self._failed:
                self._on_error(describe_failure(frame_number, f"{type(error).__name__}: {error}"))
            self._failed = True
