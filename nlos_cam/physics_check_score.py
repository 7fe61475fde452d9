"""How far the echoes that a renderer expects explain the maps that a lidar gave: arrays in, a score out.

Each cell tells one echo of two, the strongest (S5): the bare wall's own, or that of three bounces. Where both are about
as strong, a small error of the object swaps them and moves the depth by decimetres. So both are held against what was
seen, and the one that explains it better counts. With r = seen less expected and s a tolerance that holds the noise:

    h = (depth r / s)^2 + (log intensity r / s)^2 + (log of how much the other echo is stronger / s)^2
    cost = h / (1 + h)                          0 explained, 1 not at all; and the mean of it over the cells
    score = (cost - NOISE_COST) / (cost of the bare bench - NOISE_COST), the one above at least 0, the one below at
            least LEAST_UNEXPLAINED

Two things are not known beforehand and fitted: the device's gain, from the cells that show the bare wall, and the
object's albedo, to within a factor of MOST_ALBEDO, as the one of the least cost. A wider range of albedos would explain
any object that is not there as a dark one.
"""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.frames import SATURATED, LidarMaps
from nlos_cam.render.sensor.model import SensorModel

WALL_TOLERANCE_M = 0.003
"""Of the bare wall's depth: what a bench's record leaves."""
ECHO_TOLERANCE_M = 0.01
"""Of a three-bounce echo's depth: two bins, and the least that reconstructions err by."""
LOG_TOLERANCE = 0.6
"""Of an intensity's logarithm, a factor of 1.8: what distance and slope of a reconstruction err by."""
MOST_ALBEDO, ALBEDOS = 4 / 3, 5
NOISE_COST = 0.006
"""What the sensor's noise, and cells of many pixels, leave of a bare bench that is explained."""
LEAST_UNEXPLAINED = 0.02
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
    albedos = np.geomspace(1 / MOST_ALBEDO, MOST_ALBEDO, ALBEDOS) if (expected.echo > 0).any() else np.ones(1)
    costs = [mean_cost(seen, expected, gain, albedo) for albedo in albedos]
    best = int(np.argmin(costs))
    unexplained = max(mean_cost(seen, bare, gain, 1.0) - NOISE_COST, LEAST_UNEXPLAINED)
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
