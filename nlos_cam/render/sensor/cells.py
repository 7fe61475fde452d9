"""Maps of one exposure without its images: each cell draws its pixels' noise and reduces them while
they are at hand.

The law is that of `sensor.expose` and the reduction of frames: without noise the maps are the same
bits, with noise every pixel has its own two deviates. They come from a counter, so that a cell's
noise depends on the seed and the cell alone, and are quantiles of the normal distribution, looked
up: drawing them took a third of a dataset's time. Expected maps spread the deviates of a cell's
pixels evenly over the distribution instead of drawing them.
"""

from functools import lru_cache
from statistics import NormalDist
from typing import Any, NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Int32, Int64
from numpy.typing import NDArray

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, NO_SAMPLE, SATURATED, inner, reduce_cell
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, FARTHEST, MAX_CONFIDENCE

QUANTILES = 1 << 16
"""Equally likely values of a deviate, up to 4.3 standard deviations."""
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST = np.uint64(0xBF58476D1CE4E5B9)
SECOND = np.uint64(0x94D049BB133111EB)
"""Constants of SplitMix64 (Steele, Lea and Flood 2014): its outputs are mixed values of a
counter.
"""
GOLDEN_SHARE = 0.6180339887498949
"""Multiples of the golden ratio's fraction are spread evenly, whatever their number."""


@lru_cache(maxsize=1)
def normal_quantiles() -> Float32:
    """Return the middles of QUANTILES equally likely parts of the normal distribution, scaled to
    variance 1.
    """
    # Middles of equally likely parts lose the tails' variance: it is scaled back to 1.
    lower = np.array([NormalDist().inv_cdf((k + 0.5) / QUANTILES) for k in range(QUANTILES // 2)])
    every = np.concatenate([lower, -lower[::-1]])
    return (every / every.std()).astype(np.float32)


@numba.njit(cache=True, error_model="numpy")
def draw_deviates(
    seed: np.uint64, first: int, count: int, quantiles: Float32, light: Float32, ranges: Float32
) -> None:
    """Fill in two normal deviates for each of some pixels, numbers first to first + count of the
    seed's stream.
    """
    # Counter-based: pixel i has the same deviates whichever pixels are drawn, on any thread. The
    # two halves of one word choose both of them.
    for i in range(count):
        word = seed + np.uint64(first + i) * GOLDEN
        word = (word ^ (word >> np.uint64(30))) * FIRST
        word = (word ^ (word >> np.uint64(27))) * SECOND
        word = word ^ (word >> np.uint64(31))
        light[i] = quantiles[word & np.uint64(QUANTILES - 1)]
        ranges[i] = quantiles[(word >> np.uint64(32)) & np.uint64(QUANTILES - 1)]


@numba.njit(cache=True, error_model="numpy")
def spread_deviates(count: int, quantiles: Float32, light: Float32, ranges: Float32) -> None:
    """Fill in two normal deviates for each of some pixels: evenly spread over the distribution, in
    two orders.
    """
    # The first deviate by equal steps, the second by steps of the golden ratio (Kronecker
    # sequence): spread evenly each by itself and together.
    for i in range(count):
        light[i] = quantiles[np.int64((i + 0.5) / count * QUANTILES)]
        ranges[i] = quantiles[np.int64((i + 0.5) * GOLDEN_SHARE % 1.0 * QUANTILES)]


class PixelOrder(NamedTuple):
    """Pixels in the order of their map cells, and in each of the echoes' cells: runs of pixels see
    the same echo.
    """

    pixel: Int64
    """(p,)."""
    start: Int64
    """(n + 1,); place in `pixel` at which each map cell begins; cells without a pixel are empty."""
    first_run: Int64
    """(n + 1,); run with which each map cell begins."""
    run_start: Int64
    """(r + 1,); place in `pixel` at which each run begins."""
    run_echo: Int64
    """(r,); flat index of a run's echo."""

    @classmethod
    def of(cls, cell: Int32, echo: Int32) -> "PixelOrder":
        """Return the order of pixels (p,) with their map cells and the cells of their echoes."""
        # Sorted by map cell, then by echo: cells and runs are slices.
        pixel = np.lexsort((echo, cell))
        cells = cell[pixel]
        echoes = echo[pixel]
        begins = np.flatnonzero(np.diff(cells, prepend=-1) | np.diff(echoes, prepend=-1))
        numbers = np.arange(MAP_ROWS * MAP_COLUMNS + 1)
        # A run ends where the next one begins, the last at the end of all pixels.
        run_start = np.append(begins, pixel.size)
        first_run = np.searchsorted(cells[begins], numbers)
        return cls(
            pixel,
            np.searchsorted(cells, numbers),
            first_run,
            run_start,
            echoes[begins].astype(np.int64),
        )


@numba.njit(cache=True, error_model="numpy", nogil=True)
def expose_cells(
    optics: Any,
    echoes: Any,
    order: PixelOrder,
    quantiles: Float32,
    seed: np.uint64,
    noisy: tuple[bool, bool],
    bias_m: Float32,
    chain: Any,
    expected: bool,
) -> tuple[Float32, Float32]:
    """Return depth and intensity (n,) of n map cells, NaN and 0 without valid samples; of an even
    wall alone.

    Arguments are those of `sensor.expose`, with the pixels in that order. `noisy` says whether
    light and range have noise; `expected` spreads it in place of drawing it.
    """
    cells = order.start.size - 1
    most = np.diff(order.start).max()
    depth = np.full(cells, np.nan, np.float32)
    intensity = np.zeros(cells, np.float32)
    light = np.empty(most, np.float32)
    ranges = np.empty(most, np.float32)
    bits = np.empty(most, np.int32)
    counts = np.empty(most, np.uint8)
    middle = np.empty(2, np.int32)
    samples_m = bits.view(np.float32)
    middle_m = middle.view(np.float32)
    spread = 0  # pixels over which the deviates are spread already
    # Cell by cell: a cell's pixels are reduced while they are in the first cache.
    for k in range(cells):
        pixels = order.start[k + 1] - order.start[k]
        start = order.start[k]
        if expected:
            if pixels != spread:
                spread_deviates(pixels, quantiles, light, ranges)
                spread = pixels
        elif noisy[0] or noisy[1]:
            draw_deviates(seed, start, pixels, quantiles, light, ranges)
        for run in range(order.first_run[k], order.first_run[k + 1]):
            begin = order.run_start[run]
            end = order.run_start[run + 1]
            c = order.run_echo[run]
            some = slice(begin - start, end - start)
            echo = echoes.peak[c], echoes.runner_up[c], echoes.surety[c], echoes.path_m[c]
            _light(begin, optics, echo, light[some], noisy[0], chain, counts[some])
            _range(begin, optics, echo, ranges[some], noisy[1], bias_m, chain, samples_m[some])
        # Positive floats order like their bits, so the median is found on integers.
        valid = np.int32(0)
        for i in range(pixels):
            is_return = bits[i] > 0
            bits[i] = bits[i] if is_return else NO_SAMPLE
            valid += np.int32(is_return)
        if valid:
            found = reduce_cell(
                bits[:pixels], samples_m[:pixels], counts[:pixels], valid, middle, middle_m
            )
            depth[k], intensity[k] = found
    return depth, intensity


# Two loops over few arrays each: the compiler turns no loop into vector operations that has more
# pairs of arrays than it is willing to check for overlap.


@inner(error_model="numpy")
def _light(
    start: int,
    optics: Any,
    echo: tuple[Any, Any, Any, Any],
    deviates: Float32,
    noisy: bool,
    chain: Any,
    counts: NDArray[np.uint8],
) -> None:
    """Fill in the counts of some pixels that see one echo: the light of `sensor.expose`, without
    branches.
    """
    # Every choice is a select, not a branch: pixels are computed side by side.
    peak = echo[0]
    direct = optics.direct[start : start + counts.size]
    for k in range(counts.size):
        intensity = max(peak, direct[k])
        light = chain.gain * intensity + chain.ambient_counts
        if noisy:
            light += deviates[k] * np.sqrt(chain.read_variance + chain.shot_variance * light)
        light = min(light, SATURATED) - chain.ambient_counts
        counts[k] = np.uint8(np.int32(max(light, 0.0) + 0.5)) if intensity > 0 else np.uint8(0)


@inner(error_model="numpy")
def _range(
    start: int,
    optics: Any,
    echo: tuple[Any, Any, Any, Any],
    deviates: Float32,
    noisy: bool,
    bias_m: Float32,
    chain: Any,
    depth_m: Float32,
) -> None:
    """Fill in the depth of some pixels that see one echo, 0 for none: the range of `sensor.expose`,
    likewise.
    """
    # Loads come before the selects, so that none depends on a choice.
    biased = bias_m.size > 0
    dying = optics.dead.size > 0
    end = start + depth_m.size
    direct = optics.direct[start:end]
    sureties = optics.surety[start:end]
    lengths_m = optics.length_m[start:end]
    cos_axis = optics.cos_axis[start:end]
    off_m = bias_m[start:end]
    dead = optics.dead[start:end]  # empty where there is none
    peak = echo[0]
    runner_up = echo[1]
    echo_surety = echo[2]
    half_m = echo[3] / 2
    for k in range(depth_m.size):
        own = direct[k]
        own_surety = sureties[k]
        own_m = lengths_m[k]  # loads outside of choices
        wins = peak > own
        intensity = peak if wins else own
        surety = echo_surety if wins else own_surety
        length_m = half_m if wins else own_m
        second = max(min(own, peak), runner_up)
        sure = MAX_CONFIDENCE * (surety * (0.5 + 0.5 * (1 - second / intensity))) + 0.5 >= 1
        depth = np.float64(length_m * cos_axis[k])
        if biased:
            depth += off_m[k]
        if noisy:
            depth += deviates[k] * (chain.range_noise_m + chain.range_noise_per_m * depth)
        units = np.floor(min(depth / DEPTH_UNIT_M, FARTHEST) + 0.5)
        alive = not dead[k] if dying else True
        returns = (intensity > 0) & sure & (units >= 1) & alive
        depth_m[k] = np.float32(units) * np.float32(DEPTH_UNIT_M) if returns else np.float32(0)
