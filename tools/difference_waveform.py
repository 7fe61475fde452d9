"""An echo of a pulse of some width: where its peak lies, and how high, once later light is mixed into it.

The receiver is one of correlation: the waveform is each echo times g(t) = exp(-t^2 / 2 s^2), of the pulse's full width
at half height and of height 1, so that a lone echo is as high as its light; the path is where the waveform is highest,
found between the samples. A lidar that correlates chips of 1 ns has a peak of that width, but a sharper one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.render.echoes import SIGMAS_PER_FWHM
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S

REACH_SIGMAS = 6.0
"""Beyond this the pulse is 1.5e-8 of its height."""
CHIP_NS, RISE_NS = 1.0, 0.3
"""The L515's data sheet on its laser: a pulse's duration, and its rise."""


def pulse_sigma_m(pulse_ns: float) -> float:
    """The standard deviation, in path length, of a Gaussian pulse of that full width at half height."""
    return pulse_ns * 1e-9 * SPEED_OF_LIGHT_M_PER_S * float(SIGMAS_PER_FWHM)


def pulse(off_m: Float64, sigma_m: float) -> Float64:
    """g: the pulse at `off_m` of path length from its middle, 1 in its middle."""
    return np.exp(-0.5 * np.square(off_m / sigma_m))


def centres_m(bins: int, bin_m: float) -> Float64:
    """The path lengths (bins,) in the middle of bins that begin at 0."""
    return (np.arange(bins, dtype=np.float64) + 0.5) * bin_m


@dataclass(frozen=True)
class Peak:
    """What weak later light meets: g of a lone echo, of height 1."""

    slope: Callable[[Float64], Float64]
    """g' at paths before the peak, as a function of how far before it; positive there."""
    bend: float
    """-g'' at the peak."""


def gaussian_peak(pulse_ns: float) -> Peak:
    """That of `received`: g' = -t g / s^2."""
    sigma_m = pulse_sigma_m(pulse_ns)
    return Peak(lambda off_m: off_m / sigma_m**2 * pulse(off_m, sigma_m), 1 / sigma_m**2)


def chips_peak() -> Peak:
    """A sharper one: chips of CHIP_NS that are correlated, a triangle, smeared by a Gaussian as the laser rises.

    g'(t) = (N(t + T) - 2 N(t) + N(t - T)) / T with N the normal distribution; -g''(0) = 2 (n(0) - n(T)) / T with n its
    density.
    """
    chip_m = CHIP_NS * 1e-9 * SPEED_OF_LIGHT_M_PER_S
    sigma_m = RISE_NS * 1e-9 * SPEED_OF_LIGHT_M_PER_S / 2.563  # from 10 to 90 %
    places_m = np.linspace(-2 * chip_m, 2 * chip_m, 4001)
    normal = np.array([0.5 * (1 + erf(at / sigma_m / sqrt(2))) for at in places_m])
    before = (np.interp(places_m + at, places_m, normal) for at in (chip_m, 0.0, -chip_m))
    slope = np.array([1.0, -2.0, 1.0]) @ np.stack(list(before))
    bend = 2 * (1 - exp(-0.5 * (chip_m / sigma_m) ** 2)) / (sqrt(2 * pi) * sigma_m)
    return Peak(lambda off_m: np.interp(-off_m, places_m, slope) / chip_m, bend / chip_m)


def first_order(direct: Float64, path_m: Float64, later: Float64, bin_m: float, peak: Peak) -> Float64:
    """By how much weak later light (n, bins) shifts the peak (n,) of a direct return (n,), in metres of path.

    D g'(t) + sum h_k g'(t - dL_k) = 0 has, to first order in h / D, the root t = sum h_k g'(-dL_k) / (-D g''(0)); of a
    Gaussian that is sum h_k dL_k g(dL_k) / D. It errs by a share as large as the peak's relative rise.
    """
    off_m = centres_m(later.shape[1], bin_m) - path_m[:, None]
    return (later * peak.slope(off_m)).sum(1) / (direct * peak.bend)


def received(direct: Float64, path_m: Float64, later: Float64, bin_m: float, sigma_m: float) -> tuple[Float64, Float64]:
    """Path length (n,) and height (n,) of the highest peak, whatever the strength of the later light (n, bins).

    Sampled at the bins' centres; between them by a parabola through the logarithm, which is exact for a lone echo.
    """
    reach = int(np.ceil(REACH_SIGMAS * sigma_m / bin_m))
    bins = max(later.shape[1], int(np.ceil(path_m.max() / bin_m))) + reach
    shape = pulse(np.arange(-reach, reach + 1, dtype=np.float64) * bin_m, sigma_m)
    size = bins + len(shape)
    wave = np.fft.irfft(np.fft.rfft(later, size, axis=1) * np.fft.rfft(shape, size), size, axis=1)
    wave = wave[:, reach : reach + bins] + direct[:, None] * pulse(centres_m(bins, bin_m) - path_m[:, None], sigma_m)
    top = wave.argmax(1).clip(1, bins - 2)
    rows = np.arange(len(wave))
    before, at, after = (np.log(np.maximum(wave[rows, top + step], np.finfo(float).tiny)) for step in (-1, 0, 1))
    share = 0.5 * (before - after) / (before - 2 * at + after)
    return (top + 0.5 + share) * bin_m, np.exp(at - 0.25 * (before - after) * share)
