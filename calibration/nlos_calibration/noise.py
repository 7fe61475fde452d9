"""The noise of the lidar's range: of one sample, and of the mean over many.

Streaming statistics of depth frames: mean, spread and number of each pixel's samples, without the flicker.
"""

from dataclasses import dataclass, field, replace
from math import exp, pi, sqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64

Depth = TypeVar("Depth", float, Float64)

NOISE_FLOOR_M, NOISE_PER_METRE = 0.0005, 0.002
"""Standard deviation of one depth sample: the floor, and what each metre of depth adds."""
QUANTUM_M = 0.00025
"""The L515's unit of depth."""
MIN_SPREAD_SAMPLES = 4
"""A spread over fewer samples says too little."""
STATISTICS_POINTS = 20_000
"""Enough for medians and percentiles."""


def depth_noise_m(depth_m: Depth) -> Depth:
    """The standard deviation of a depth sample at `depth_m`, any shape."""
    return NOISE_FLOOR_M + NOISE_PER_METRE * depth_m


@dataclass(frozen=True)
class MeanNoise:
    """What the mean of a pixel's samples is uncertain by: the sample's noise over the root of their number.

    It does not fall below what rounding leaves. Noise carries a sample over the steps of its rounding, so that the mean
    errs by rounding less the noisier the sample is: by the first harmonic of the sawtooth, QUANTUM_M / sqrt(12)
    x exp(-2 pi^2 (noise / QUANTUM_M)^2). At the nominal noise nothing is left of it; without noise all of it.
    Ripples of the lidar are no noise: they show in the residuals, which scale the covariance (`flatness`).
    """

    samples: Float64 = field(default_factory=lambda: np.ones(1))
    """(N,); how many were averaged at each point; or (1,), at each as many."""
    scale: float = 1.0
    """A sample's noise over the nominal."""
    measured: bool = False
    """Whether `scale` was, from the spread of samples; else it is a guess."""

    def of(self, depth_m: Float64) -> Float64:
        """The standard deviation (N,) of means at `depth_m` (N,)."""
        rounding_m = QUANTUM_M / sqrt(12) * exp(-2 * (pi * self.scale * NOISE_FLOOR_M / QUANTUM_M) ** 2)
        return np.sqrt(self.scale**2 * depth_noise_m(depth_m) ** 2 / self.samples + rounding_m**2)

    def at(self, points: NDArray[np.bool_] | slice) -> "MeanNoise":
        """The noise of some of the points."""
        return self if len(self.samples) == 1 else replace(self, samples=self.samples[points])


def measured_noise(depth_m: Float64, spread_m: Float64, samples: NDArray[np.int64]) -> MeanNoise:
    """The noise of means at `depth_m` (N,) of `samples` (N,), from their spread (N,); NaN where there is none.

    The scale is a median over the points, since a few flicker; that of a variance from n samples is
    (1 - 2 / (9 (n - 1)))^3 of its mean (Wilson and Hilferty). From too few samples it stays nominal.
    """
    known = np.flatnonzero(np.isfinite(depth_m) & (samples >= MIN_SPREAD_SAMPLES))
    known = known[:: max(len(known) // STATISTICS_POINTS, 1)]
    averaged = np.maximum(samples, 1).astype(np.float64)
    if len(known) == 0:
        return MeanNoise(averaged)
    unbiased = (1.0 - 2.0 / (9.0 * (averaged[known] - 1.0))) ** 3
    variance = np.median((spread_m[known] / depth_noise_m(depth_m[known])) ** 2 / unbiased)
    return MeanNoise(averaged, sqrt(float(variance)), measured=True)


FIRST_FRAMES = 5
"""Their median is what later samples are held against."""
STRAY_SIGMAS = 20.0
"""Samples farther than this (in nominal noise) from that median are no echo of the same surface. Wide on purpose: at
four times the nominal noise nothing of it is cut, and what strays within is told by the spread."""


class DepthMean:
    """The mean of each pixel over the frames that had a return there; holds a few maps, not the frames.

    Sums are kept of the deviations from the median of the first frames: a sample far from it is not counted.
    """

    def __init__(self, height: int, width: int) -> None:
        self.frames = 0
        self._first: list[Float64] = []
        self._median_m: Float64 | None = None
        self._count = np.zeros((height, width), np.int64)
        self._sum_m, self._squares_m2 = np.zeros((height, width)), np.zeros((height, width))

    def add(self, depth_m: NDArray[np.floating]) -> None:
        """Take one frame (height, width) in; NaN, infinite and not positive samples are no return."""
        valid_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan).astype(np.float64)
        self.frames += 1
        if self._median_m is not None:
            self._take(valid_m, self._median_m)
            return
        self._first.append(valid_m)
        if len(self._first) == FIRST_FRAMES:
            self._settled_m()

    def mean_m(self) -> Float64:
        """(height, width); NaN where fewer than half of the frames had a return."""
        mean_m = self._settled_m() + self._sum_m / np.maximum(self._count, 1)
        return np.where(2 * self._count >= max(self.frames, 1), mean_m, np.nan)

    def spread_m(self) -> Float64:
        """(height, width); the standard deviation of a sample, NaN where there are fewer than two."""
        self._settled_m()
        freedom = np.where(self._count > 1, self._count - 1.0, np.nan)
        squares_m2 = self._squares_m2 - self._sum_m**2 / np.maximum(self._count, 1)
        return np.sqrt(np.maximum(squares_m2, 0.0) / freedom)

    def count(self) -> NDArray[np.int64]:
        """(height, width); how many samples each mean is of."""
        self._settled_m()
        return self._count.copy()

    def noise(self) -> MeanNoise:
        """What the flattened mean is uncertain by."""
        return measured_noise(self.mean_m().ravel(), self.spread_m().ravel(), self.count().ravel())

    def _settled_m(self) -> Float64:
        """The median of the first frames, once they are there or a result is wanted: their sums are about it."""
        if self._median_m is None:
            self._median_m = _median(np.stack(self._first)) if self._first else np.full(self._count.shape, np.nan)
            for depth_m in self._first:
                self._take(depth_m, self._median_m)
            self._first.clear()
        return self._median_m

    def _take(self, depth_m: Float64, median_m: Float64) -> None:
        off_m = depth_m - median_m
        counted = np.abs(off_m) <= STRAY_SIGMAS * depth_noise_m(median_m)  # False for NaN
        off_m[~counted] = 0.0
        self._count += counted
        self._sum_m += off_m
        self._squares_m2 += off_m**2


def _median(frames_m: Float64) -> Float64:
    """The median of each pixel over frames (n, height, width) without the NaNs, of an even number the upper."""
    ordered = np.sort(frames_m, axis=0)  # NaN last
    middle = np.isfinite(frames_m).sum(axis=0) // 2
    return np.take_along_axis(ordered, middle[np.newaxis], axis=0)[0]
