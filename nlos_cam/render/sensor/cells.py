"""Maps of one exposure without its images: each cell draws its pixels' noise and reduces them while they are at hand.

The law is that of `sensor.expose` and the reduction of frames: without noise the maps are the same bits, with noise
every pixel has its own two deviates. They come from a counter, so that a cell's noise depends on the seed and the cell
alone, and are quantiles of the normal distribution, looked up: drawing them took a third of a dataset's time.
Expected maps spread the deviates of a cell's pixels evenly over the distribution instead of drawing them.
"""

from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Int32, Int64
from numpy.typing import NDArray

from nlos_cam.frames import NO_SAMPLE, SATURATED, inner, reduce_cell
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, FARTHEST, MAX_CONFIDENCE

QUANTILES = 1 << 16
"""Equally likely values of a deviate, up to 4.3 standard deviations."""
GOLDEN, FIRST, SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""Constants of SplitMix64 (Steele, Lea and Flood 2014): its outputs are mixed values of a counter."""
GOLDEN_SHARE = 0.6180339887498949
"""Multiples of the golden ratio's fraction are spread evenly, whatever their number."""


@lru_cache(maxsize=1)
def normal_quantiles() -> Float32:
    """Return the middles of QUANTILES equally likely parts of the normal distribution, scaled to variance 1."""
    lower = np.array([NormalDist().inv_cdf((k + 0.5) / QUANTILES) for k in range(QUANTILES // 2)])
    every = np.concatenate([lower, -lower[::-1]])
    return (every / every.std()).astype(np.float32)


@numba.njit(cache=True, error_model="numpy")
def draw_deviates(seed: np.uint64, first: int, count: int, quantiles: Float32, light: Float32, ranges: Float32) -> None:
    """Fill in two normal deviates for each of some pixels, numbers first to first + count of the seed's stream."""
    for i in range(count):
        word = seed + np.uint64(first + i) * GOLDEN
        word = (word ^ (word >> np.uint64(30))) * FIRST
        word = (word ^ (word >> np.uint64(27))) * SECOND
        word = word ^ (word >> np.uint64(31))
        light[i] = quantiles[word & np.uint64(QUANTILES - 1)]
        ranges[i] = quantiles[(word >> np.uint64(32)) & np.uint64(QUANTILES - 1)]


@numba.njit(cache=True, error_model="numpy")
def spread_deviates(count: int, quantiles: Float32, light: Float32, ranges: Float32) -> None:
    """Fill in two normal deviates for each of some pixels: evenly spread over the distribution, in two orders."""
    for i in range(count):
        light[i] = quantiles[np.int64((i + 0.5) / count * QUANTILES)]
        ranges[i] = quantiles[np.int64((i + 0.5) * GOLDEN_SHARE % 1.0 * QUANTILES)]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def expose_cells(
    optics: Any, echoes: Any, cell: Int32, starts: Int64, quantiles: Float32, seed: np.uint64, noisy: tuple[bool, bool],
    bias_m: Float32, chain: Any, expected: bool,
) -> tuple[Float32, Float32]:  # fmt: skip
    """Return depth and intensity (n,) of n map cells, NaN and 0 without valid samples; of an even wall alone.

    Arguments are those of `sensor.expose`, with the pixels of each map cell in a row, from its place in `starts`
    (n + 1,) on. `noisy` says whether light and range have noise; `expected` spreads it in place of drawing it.
    """
    most = np.diff(starts).max()
    depth, intensity = np.full(starts.size - 1, np.nan, np.float32), np.zeros(starts.size - 1, np.float32)
    light, ranges = np.empty(most, np.float32), np.empty(most, np.float32)
    bits, counts, middle = np.empty(most, np.int32), np.empty(most, np.uint8), np.empty(2, np.int32)
    samples_m, middle_m = bits.view(np.float32), middle.view(np.float32)
    spread = 0  # pixels over which the deviates are spread already
    for k in range(depth.size):
        start, pixels = starts[k], starts[k + 1] - starts[k]
        if expected:
            if pixels != spread:
                spread_deviates(pixels, quantiles, light, ranges)
                spread = pixels
        elif noisy[0] or noisy[1]:
            draw_deviates(seed, start, pixels, quantiles, light, ranges)
        _pixels(start, pixels, optics, echoes, cell, light, ranges, noisy, bias_m, chain, samples_m, counts)
        valid = np.int32(0)
        for i in range(pixels):
            is_return = bits[i] > 0
            bits[i] = bits[i] if is_return else NO_SAMPLE
            valid += np.int32(is_return)
        if valid:
            found = reduce_cell(bits[:pixels], samples_m[:pixels], counts[:pixels], valid, middle, middle_m)
            depth[k], intensity[k] = found
    return depth, intensity


@inner(error_model="numpy")
def _pixels(
    start: int, pixels: int, optics: Any, echoes: Any, cell: Int32, light_deviates: Float32, range_deviates: Float32,
    noisy: tuple[bool, bool], bias_m: Float32, chain: Any, depth_m: Float32, counts: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Fill in depth, 0 for none, and counts of some pixels: the chain of `sensor.expose` without branches."""
    biased, dying = bias_m.size > 0, optics.dead.size > 0
    for k in range(pixels):
        i = start + k
        c = np.uint32(cell[i])
        own, peak, runner_up = optics.direct[i], echoes.peak[c], echoes.runner_up[c]
        wins = peak > own
        intensity = peak if wins else own
        surety = echoes.surety[c] if wins else optics.surety[i]
        length_m = echoes.path_m[c] / 2 if wins else optics.length_m[i]
        second = max(min(own, peak), runner_up)
        light = chain.gain * intensity + chain.ambient_counts
        if noisy[0]:
            light += light_deviates[k] * np.sqrt(chain.read_variance + chain.shot_variance * light)
        light = min(light, SATURATED) - chain.ambient_counts
        counts[k] = np.uint8(np.int32(max(light, 0.0) + 0.5)) if intensity > 0 else np.uint8(0)
        sure = MAX_CONFIDENCE * (surety * (0.5 + 0.5 * (1 - second / intensity))) + 0.5 >= 1
        depth = np.float64(length_m * optics.cos_axis[i])
        if biased:
            depth += bias_m[i]
        if noisy[1]:
            depth += range_deviates[k] * (chain.range_noise_m + chain.range_noise_per_m * depth)
        units = np.floor(min(depth / DEPTH_UNIT_M, FARTHEST) + 0.5)
        alive = not optics.dead[i] if dying else True
        returns = (intensity > 0) & sure & (units >= 1) & alive
        depth_m[k] = np.float32(units) * np.float32(DEPTH_UNIT_M) if returns else np.float32(0)
