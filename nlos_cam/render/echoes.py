"""Echoes: of all light that comes back along a beam, the strongest bin (S5), after the pulse has
spread it.
"""

from dataclasses import dataclass
from math import erf, sqrt
from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64
from numpy.typing import NDArray

from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S, Beams

SIGMAS_PER_FWHM = 1 / np.sqrt(8 * np.log(2))
TRANSFORM_VALUES = 1 << 23
"""Values of the waveforms that are transformed at once."""


class StoppedBeams(NamedTuple):
    """Beams that the hidden object stops on their way to the wall, and what it returns of them."""

    direct: Float32
    """(rows, columns); in units of I0, NaN for beams that it does not stop."""
    length_m: Float32
    """(rows, columns); d1, up to the object; NaN likewise."""


@dataclass(frozen=True)
class MultiBounce:
    """Strongest and second strongest bins of each beam: of three bounces, or of the whole
    waveform.
    """

    peak: Float32
    """(rows, columns); 0 if no path comes back."""
    runner_up: Float32
    """(rows, columns)."""
    path_m: Float32
    """(rows, columns); path length at the center of the strongest bin, NaN if there is none."""
    direct_included: bool = False
    """True if the waveform contains the direct return: a pulse with a width mixes it with the
    rest.
    """
    stopped: StoppedBeams | None = None
    """Beams that have no direct return of the wall; None where the object stops none, or where the
    waveform contains the direct return.
    """

    def reshape(self, shape: tuple[int, int]) -> "MultiBounce":
        """Return the echoes in the shape of an image."""
        maps = self.peak.reshape(shape), self.runner_up.reshape(shape), self.path_m.reshape(shape)
        return MultiBounce(*maps, self.direct_included)

    def spread_over(self, which: NDArray[np.bool_]) -> "MultiBounce":
        """Return the echoes (k,) of the beams in a mask as (n,), with no echo for the others."""
        every = no_echoes(len(which))
        every.peak[which] = self.peak
        every.runner_up[which] = self.runner_up
        every.path_m[which] = self.path_m
        return every


def no_echoes(count: int) -> MultiBounce:
    """Return the echoes (n,) of beams that light no wall, or find nothing hidden."""
    dark = np.zeros((2, count), np.float32)
    return MultiBounce(dark[0], dark[1], np.full(count, np.nan, np.float32))


@numba.njit(cache=True)
def strongest_between(
    histogram: NDArray[np.floating], start: int, end: int
) -> tuple[int, np.float32, np.float32]:
    """Return index and value of the strongest bin from `start` to before `end`, and the value of
    the second.
    """
    # One pass with strict comparisons: a tie stays with the shorter path, and dark bins never win.
    best = np.float32(0)
    second = np.float32(0)
    at = 0
    for k in range(start, end):
        value = np.float32(histogram[k])
        if value > best:  # a tie stays with the shorter path
            second = best
            best = value
            at = k
        elif value > second:
            second = value
    return at, best, second


@numba.njit(cache=True, parallel=True)
def _two_strongest(histogram: NDArray[np.floating]) -> tuple[NDArray[np.int64], Float32, Float32]:
    rows, bins = histogram.shape
    winner = np.zeros(rows, np.int64)
    peak = np.zeros(rows, np.float32)
    second = np.zeros(rows, np.float32)
    for i in numba.prange(rows):
        winner[i], peak[i], second[i] = strongest_between(histogram[i], 0, bins)
    return winner, peak, second


@numba.njit(cache=True, parallel=True)
def _strongest_beyond(
    histogram: NDArray[np.floating], winner: NDArray[np.int64], beyond: int
) -> Float32:
    """Return the strongest bin of each row that is more than `beyond` bins from its winner."""
    rows, bins = histogram.shape
    found = np.zeros(rows, np.float32)
    for i in numba.prange(rows):
        for k in range(bins):
            if abs(k - winner[i]) > beyond:
                found[i] = max(found[i], np.float32(histogram[i, k]))
    return found


def strongest(histogram: NDArray[np.floating], bin_m: float, pulse_ns: float = 0.0) -> MultiBounce:
    """Return the strongest and second strongest bins of histograms (n, bins); ties go to the
    shortest path.

    After a pulse the second one is of another echo: more than the pulse's full width away.
    """
    winner, peak, second = _two_strongest(histogram)
    if pulse_ns:
        beyond = int(np.ceil(pulse_bins(pulse_ns, bin_m) / SIGMAS_PER_FWHM))
        second = _strongest_beyond(histogram, winner, beyond)
    path = np.where(peak > 0, (winner + 0.5) * bin_m, np.nan).astype(np.float32)
    return MultiBounce(peak, second, path)


def compete(beams: Beams, multi: MultiBounce) -> tuple[Float32, Float32, Float32]:
    """Return depth, intensity and margin (rows, columns) of the strongest echoes (S5); ties go to
    the direct return.
    """
    # S5: direct return and strongest three-bounce bin compete; the larger one is the echo.
    direct = beams.direct.astype(np.float32).reshape(beams.shape)
    peak = multi.peak
    if multi.direct_included:
        direct = np.zeros_like(direct)
    wins = peak > direct
    intensity = np.where(wins, peak, direct)
    second = np.maximum(np.where(wins, direct, peak), multi.runner_up)
    # The device divides every path by two, also one of three bounces (S5).
    length = np.where(wins, multi.path_m / 2, beams.length_m.reshape(beams.shape))
    depth = np.where(intensity > 0, length * beams.cos_axis.reshape(beams.shape), np.nan)
    margin = np.where(
        intensity > 0, 1 - second / np.maximum(intensity, np.finfo(np.float32).tiny), 0
    )
    return depth.astype(np.float32), intensity, margin.astype(np.float32)


def add_direct(histogram: Float32, beams: Beams, bin_m: float) -> Float32:
    """Return histograms (n, bins) with each beam's direct return in the bin of its path; more bins
    if it needs them.
    """
    returns = np.flatnonzero(beams.direct > 0)
    # There and back along one leg: the path is 2 d1.
    at = np.floor(2 * beams.length_m[returns] / bin_m).astype(np.int64)
    longer = max(int(at.max(initial=-1)) + 1 - histogram.shape[1], 0)
    whole = np.pad(histogram, [(0, 0), (0, longer)])
    whole[returns, at] += beams.direct[returns].astype(np.float32)
    return whole


def pulse_bins(pulse_ns: float, bin_m: float) -> float:
    """Return the standard deviation, in path-length bins, of a Gaussian pulse with that full width
    at half maximum.
    """
    # A Gaussian is at half its maximum where x^2 = 2 ln(2) sigma^2, so FWHM = sqrt(8 ln 2) sigma.
    return pulse_ns * 1e-9 * SPEED_OF_LIGHT_M_PER_S * SIGMAS_PER_FWHM / bin_m


def pulse_tail(pulse_ns: float, bin_m: float) -> int:
    """Return the number of bins by which the pulse makes a histogram longer."""
    return len(_pulse(pulse_ns, bin_m)) // 2 if pulse_ns else 0


def with_pulse(
    histogram: Float32, pulse_ns: float, bin_m: float, at_most: int | None = None
) -> Float32:
    """Return histograms (n, bins) convolved with the pulse; longer by its tail, so that no light is
    lost, but for what would come after `at_most` bins.
    """
    if pulse_ns == 0:
        return histogram
    kernel = _pulse(pulse_ns, bin_m)
    half = len(kernel) // 2
    size = histogram.shape[1] + 2 * half
    # Convolution theorem; zero padding by the kernel's length keeps the end from wrapping to the
    # start.
    of_pulse = np.fft.rfft(kernel, size)
    kept = size - half if at_most is None else min(size - half, at_most)
    wide = np.empty((len(histogram), kept), np.float32)
    # A transform takes several times the memory of what it transforms: some rows at a time.
    at_once = max(1, TRANSFORM_VALUES // size)
    for start in range(0, len(histogram), at_once):
        rows = slice(start, start + at_once)
        spectrum = np.fft.rfft(histogram[rows].astype(np.float64), size, axis=1) * of_pulse
        # What would come before time 0 is cut, and rounding of the transform leaves tiny values
        # below 0 where there is no light.
        wide[rows] = np.maximum(np.fft.irfft(spectrum, size, axis=1)[:, half : half + kept], 0)
    return wide


def peak_share(pulse_ns: float, bin_m: float) -> float:
    """Return the share of a lone return's light that its strongest bin holds."""
    return float(_pulse(pulse_ns, bin_m).max()) if pulse_ns else 1.0


def _pulse(pulse_ns: float, bin_m: float) -> Float64:
    """Return the pulse over the bins around its middle, normalized to 1: differences of the normal
    distribution.
    """
    # Four sigmas hold all but 6e-5 of the light. Each bin gets the integral of the Gaussian over
    # it, so that pulses far narrower than a bin lose nothing.
    sigma = pulse_bins(pulse_ns, bin_m)
    half = int(np.ceil(4 * sigma)) + 1
    edges = np.arange(-half, half + 2) - 0.5
    kernel = np.diff([(1 + erf(edge / sigma / sqrt(2))) / 2 for edge in edges])
    return kernel / kernel.sum()
