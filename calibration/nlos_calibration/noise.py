"""Range noise of the lidar: of one sample and of the mean over many frames, with streaming
statistics of depth.

And 95 % intervals as text: as many digits as the interval justifies, and one unit.
"""

from dataclasses import dataclass, field, replace
from math import exp, floor, log10, pi, sqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64, Int64, Mask

Depth = TypeVar("Depth", float, Float64)

# No data sheet gives the L515's noise below 0.25 m: these are nominal values, those of the
# simulated sensor, and every fit scales them by the spread or the residuals that it finds.
NOISE_FLOOR_M = 0.0005
NOISE_PER_METRE = 0.002
"""Standard deviation of one depth sample: constant part, and increase per metre of depth."""
QUANTUM_M = 0.00025
"""Depth unit of the L515."""
MIN_SPREAD_SAMPLES = 4
"""Samples needed for a standard deviation to be used."""
STATISTICS_POINTS = 20_000
"""Points that medians and percentiles are computed from."""
MEDIAN_PER_SIGMA = 0.67449
SCATTER_PER_MEDIAN = 1.4826
"""Median of |x| of a normal distribution over its standard deviation, and the inverse."""
INTERVAL_STDS = 1.96
"""Half the width of a 95 % interval, in standard uncertainties."""
MAX_DECIMALS_MM = 2
MAX_DECIMALS_DEG = 3
"""Finest digits printed, however small the interval: an interval below one unit of them is printed
as one unit.
"""


def depth_noise_m(depth_m: Depth) -> Depth:
    """Return the standard deviation in metres of one depth sample at `depth_m`, any shape."""
    return NOISE_FLOOR_M + NOISE_PER_METRE * depth_m


@dataclass(frozen=True)
class MeanNoise:
    """Noise model of a pixel's mean depth: sample noise over the root of the number of samples,
    plus rounding.

    Ripples of the lidar are not noise: they appear in the residuals, which scale the covariance
    (`flatness`).
    """

    samples: Float64 = field(default_factory=lambda: np.ones(1))
    """(N,), number of samples at each point; or (1,), the same number everywhere."""
    scale: float = 1.0
    """Noise of a sample over the nominal noise."""
    measured: bool = False
    """True if `scale` was measured from the spread of samples; else it is the nominal 1."""

    def of(self, depth_m: Float64) -> Float64:
        """Return the standard deviation (N,) of means at `depth_m` (N,)."""
        # Noise dithers the rounding: the mean of rounded samples errs by a sawtooth of the depth,
        # convolved with the noise. The Gaussian's transform damps its first harmonic by exp(-2 pi^2
        # (sigma / quantum)^2), starting from the uniform quantum / sqrt(12): all of it without
        # noise, nothing at the nominal noise of two quanta.
        rounding_m = (
            QUANTUM_M / sqrt(12) * exp(-2 * (pi * self.scale * NOISE_FLOOR_M / QUANTUM_M) ** 2)
        )
        return np.sqrt(self.scale**2 * depth_noise_m(depth_m) ** 2 / self.samples + rounding_m**2)

    def at(self, points: Mask | slice) -> "MeanNoise":
        """Return the noise model of some of the points."""
        return self if len(self.samples) == 1 else replace(self, samples=self.samples[points])


def measured_noise(depth_m: Float64, spread_m: Float64, samples: Int64) -> MeanNoise:
    """Measure the noise of means at `depth_m` (N,) of `samples` (N,) from their standard deviations
    `spread_m` (N,).

    The scale is a median over the points, since a few flicker; it stays nominal where no point has
    enough samples.
    """
    known = np.flatnonzero(np.isfinite(depth_m) & (samples >= MIN_SPREAD_SAMPLES))
    known = known[:: max(len(known) // STATISTICS_POINTS, 1)]
    averaged = np.maximum(samples, 1).astype(np.float64)
    if len(known) == 0:
        return MeanNoise(averaged)
    # the median of chi-square with k = n - 1 degrees of freedom is k (1 - 2 / (9 k))^3 (Wilson and
    # Hilferty, 1931), so the median of sample variances is that factor below the true variance
    unbiased = (1.0 - 2.0 / (9.0 * (averaged[known] - 1.0))) ** 3
    variance = np.median((spread_m[known] / depth_noise_m(depth_m[known])) ** 2 / unbiased)
    return MeanNoise(averaged, sqrt(float(variance)), measured=True)


FIRST_FRAMES = 5
"""Number of frames whose median later samples are compared with."""
STRAY_SIGMAS = 20.0
"""Samples farther than this (in nominal noise) from that median are echoes of another surface. The
limit is wide on purpose: at four times the nominal noise it rejects no true sample, and strays
within it widen the measured spread."""


class DepthMean:
    """Streaming mean and standard deviation of each pixel's depth, without flicker. Holds sums, not
    the frames.

    The sums are of deviations from the median of the first frames; samples far from it are ignored.
    One thread.
    """

    def __init__(self, height: int, width: int) -> None:
        self.frames = 0
        self._first: list[Float64] = []
        self._median_m: Float64 | None = None
        self._count = np.zeros((height, width), np.int64)
        self._sum_m = np.zeros((height, width))
        self._squares_m2 = np.zeros((height, width))

    def add(self, depth_m: NDArray[np.floating]) -> None:
        """Add one frame (height, width); NaN, infinite and non-positive samples count as no
        return.
        """
        valid_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan).astype(
            np.float64
        )
        self.frames += 1
        if self._median_m is not None:
            self._accumulate(valid_m, self._median_m)
            return
        self._first.append(valid_m)
        if len(self._first) == FIRST_FRAMES:
            self._settle_median_m()

    def mean_m(self) -> Float64:
        """Return the mean depth (height, width); NaN where fewer than half of the frames had a
        return.
        """
        # A pixel seen in fewer than half of the frames shows now the wall and now something else.
        mean_m = self._settle_median_m() + self._sum_m / np.maximum(self._count, 1)
        return np.where(2 * self._count >= max(self.frames, 1), mean_m, np.nan)

    def spread_m(self) -> Float64:
        """Return the standard deviation of a sample (height, width); NaN where there are fewer than
        two.
        """
        self._settle_median_m()
        # sum (x - mean)^2 = sum off^2 - (sum off)^2 / n holds for deviations from any constant.
        # From the median they are as small as the noise, so that the difference loses few digits.
        freedom = np.where(self._count > 1, self._count - 1.0, np.nan)
        squares_m2 = self._squares_m2 - self._sum_m**2 / np.maximum(self._count, 1)
        return np.sqrt(np.maximum(squares_m2, 0.0) / freedom)

    def count(self) -> Int64:
        """Return the number of samples (height, width) in each mean."""
        self._settle_median_m()
        return self._count.copy()

    def noise(self) -> MeanNoise:
        """Return the noise model of the flattened mean."""
        return measured_noise(self.mean_m().ravel(), self.spread_m().ravel(), self.count().ravel())

    def _settle_median_m(self) -> Float64:
        """Return the median of the first frames, and fix it once these are complete or a result is
        asked for.
        """
        if self._median_m is not None:
            return self._median_m

        self._median_m = np.full(self._count.shape, np.nan)
        if self._first:
            self._median_m = _median(np.stack(self._first))
        for depth_m in self._first:
            self._accumulate(depth_m, self._median_m)
        self._first.clear()
        return self._median_m

    def _accumulate(self, depth_m: Float64, median_m: Float64) -> None:
        off_m = depth_m - median_m
        counted = np.abs(off_m) <= STRAY_SIGMAS * depth_noise_m(median_m)  # False for NaN
        off_m[~counted] = 0.0
        self._count += counted
        self._sum_m += off_m
        self._squares_m2 += off_m**2


def _median(frames_m: Float64) -> Float64:
    """Return each pixel's median over frames (n, height, width), ignoring NaN; the upper one of an
    even number.
    """
    # The upper of two middle samples rather than their mean: of an echo that flickers between two
    # surfaces the mean would be on neither.
    ordered = np.sort(frames_m, axis=0)  # NaN last
    middle = np.isfinite(frames_m).sum(axis=0) // 2
    return np.take_along_axis(ordered, middle[np.newaxis], axis=0)[0]


def with_mm(value_m: float, std_m: float | None, sign: str = "") -> str:
    """Return a length in metres as millimetres with its 95 % interval: "200.00 ± 0.01 mm"."""
    std_mm = None if std_m is None else 1e3 * std_m
    return f"{_with_interval(1e3 * value_m, std_mm, MAX_DECIMALS_MM, sign)} mm"


def with_degrees(value_deg: float, std_deg: float | None, sign: str = "") -> str:
    """Return an angle with its 95 % interval: "45.000 ± 0.001°"."""
    return f"{_with_interval(value_deg, std_deg, MAX_DECIMALS_DEG, sign)}°"


def _with_interval(value: float, std: float | None, max_decimals: int, sign: str) -> str:
    """Return a value and the half width of its 95 % interval; without a standard uncertainty the
    value alone.
    """
    if std is None:
        return f"{value:{sign}z.{max_decimals - 1}f}"
    half = max(INTERVAL_STDS * std, 10.0**-max_decimals)
    # one significant digit of the half width, two where it begins with 1: none after the point from
    # 2 to 20, one from 0.2 to 2, ...
    decimals = min(max(-floor(log10(half / 2.0)), 0), max_decimals)
    return f"{value:{sign}z.{decimals}f} ± {half:.{decimals}f}"
