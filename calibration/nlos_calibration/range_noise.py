"""The noise of the lidar's range: of one sample, and of the mean over many."""

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
