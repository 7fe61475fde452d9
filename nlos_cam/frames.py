"""Frames of a camera, the maps that the networks take as input, and running means of maps, all in
SI units.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import Any, TypeVar

import numba
import numpy as np
from nlos_calibration import Gravity, Intrinsics
from nlos_calibration.arrays import Float32, Int32
from numpy.typing import NDArray

from nlos_cam import kernel_cache

kernel_cache.install()  # before the first kernel: every module with kernels imports this one

MAP_ROWS = 64
MAP_COLUMNS = 80
OBJECT_PIXELS = 64
WINNER_SPREAD_M = 0.01
"""Distance from a cell's median depth within which samples count towards its intensity: they are of
one echo.
"""
SATURATED = 255
"""Full scale of the IR's 8 bits, in counts."""
MAX_SATURATED = 0.001
"""Share of saturated infrared pixels above which depth is unreliable: the L515 under-estimates it
there.
"""

Real = float | np.float32
Kernel = TypeVar("Kernel", bound=Callable[..., Any])
int64: Any = np.int64
"""Cast of indices and constants to one type: a compiled function is compiled for each type that it
is called with.
"""


def inner(**options: Any) -> Callable[[Kernel], Kernel]:
    """Return a decorator for functions that only compiled functions call; options as for
    `numba.njit`.

    Such a function is compiled on its first use, and cached. Beside each other function numba
    compiles two more, which convert the arguments of calls from Python and from C. Without them the
    first run on a machine compiles less.
    """
    compile_function: Any = numba.njit
    return compile_function(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


@dataclass(frozen=True)
class Frame:
    """Depth, infrared and confidence images of one instant."""

    depth_m: Float32
    """(height, width); distance along the optical axis, NaN where there is no return."""
    ir: NDArray[np.uint8]
    """(height, width); intensity of the return, in counts; 255 is saturated."""
    confidence: NDArray[np.uint8]
    """(height, width); 0 (low) to 15 (high)."""
    timestamp_s: float
    frame_number: int
    intrinsics: Intrinsics
    settings: Mapping[str, float] = field(default_factory=dict[str, float])
    """The device's options as read back at the start of streaming."""
    gravity_m_s2: Gravity | None = None
    """Mean of the device's accelerometer over the last second, pointing down, in the lidar frame;
    None without one, and while the device is moved.
    """
    truth_depth_m: Float32 | None = None
    """(64, 64) hidden depth over the object box, if known (as by a simulated camera)."""


@dataclass(frozen=True)
class LidarMaps:
    """Frame reduced to the (64, 80) cells of the networks' input; row 0 on top, column 79 far from
    the foot.
    """

    depth_m: Float32
    """(64, 80); median of the valid samples, NaN without any."""
    intensity: Float32
    """(64, 80); in IR counts, 0 without valid samples."""
    valid: NDArray[np.bool_]
    """(64, 80); True where a cell has a valid sample."""


def saturated_share(ir: NDArray[np.uint8]) -> float:
    """Return the share of saturated pixels in an infrared image."""
    return float(np.count_nonzero(ir == SATURATED)) / ir.size


# Depths are compared by their bits as int32: IEEE 754 orders positive floats as their bits, and
# integers vectorise. Zero has bits 0, negative depths negative bits, infinity INFINITE_BITS, and
# NaN is beyond either end.
NO_SAMPLE = np.int32(0x7FFFFFFF)
"""Bits above those of any valid depth, which sort invalid samples last."""
INFINITE_BITS = np.int32(0x7F800000)


@inner(error_model="numpy")
def _gather(
    depth_bits: Int32, ir: NDArray[np.uint8], bits: Int32, counts: NDArray[np.uint8]
) -> np.int32:
    """Copy one cell's samples to `bits` and `counts`; return how many are valid (not NaN, 0,
    negative or infinite).
    """
    valid = np.int32(0)
    k = 0
    for r in range(depth_bits.shape[0]):
        for c in range(depth_bits.shape[1]):
            sample = depth_bits[r, c]
            is_return = (sample > 0) & (sample < INFINITE_BITS)
            bits[k] = sample if is_return else NO_SAMPLE
            counts[k] = ir[r, c]
            valid += np.int32(is_return)
            k += 1
    return valid


@inner(error_model="numpy")
def _two_from(bits: Int32, rank: np.int32) -> tuple[np.int32, np.int32]:
    """Return the bits of the samples of this rank (0 is the smallest) and the next one."""
    # Bisection between the smallest and the largest valid sample, without sorting: count the
    # samples up to the middle. More than `rank` of them: the wanted one is among them, at most the
    # largest of those (`below`). Otherwise it is at least the smallest above the middle (`above`).
    # Both bounds are samples, so low meets high at the wanted one.
    low = NO_SAMPLE
    high = np.int32(0)
    for i in range(bits.size):
        low = min(low, bits[i])
        high = max(high, bits[i] if bits[i] != NO_SAMPLE else np.int32(0))
    while low < high:
        middle = low + ((high - low) >> 1)
        up_to = np.int32(0)
        below = np.int32(0)
        above = NO_SAMPLE
        for i in range(bits.size):
            is_below = bits[i] <= middle
            up_to += np.int32(is_below)
            below = max(below, bits[i] if is_below else np.int32(0))
            above = min(above, NO_SAMPLE if is_below else bits[i])
        if up_to > rank:
            high = below
        else:
            low = above
    # The next in rank is the same value where it repeats beyond the rank, else the smallest above
    # it.
    up_to = np.int32(0)
    above = NO_SAMPLE
    for i in range(bits.size):
        is_below = bits[i] <= low
        up_to += np.int32(is_below)
        above = min(above, NO_SAMPLE if is_below else bits[i])
    return low, low if up_to > rank + 1 else above


@inner(error_model="numpy")
def _mean_near(
    bits: Int32, depth_m: Float32, counts: NDArray[np.uint8], median_m: Real, spread_m: Real
) -> np.floating:
    """Return the mean count of the samples within `spread_m` of the median; NaN without any."""
    total = np.int32(0)
    near = np.int32(0)
    for i in range(bits.size):
        is_near = (bits[i] != NO_SAMPLE) & (abs(depth_m[i] - median_m) <= spread_m)
        near += np.int32(is_near)
        total += np.int32(counts[i]) if is_near else np.int32(0)
    return np.float32(total) / np.float32(near)


@inner(error_model="numpy")
def reduce_cell(
    bits: Int32,
    samples_m: Float32,
    counts: NDArray[np.uint8],
    valid: np.int32,
    middle: Int32,
    middle_m: Float32,
) -> tuple[Real, Real]:
    """Return depth and intensity of a cell's samples (n,), of which some are valid: median depth,
    and mean near it.

    `samples_m` and `middle_m` show the bits of `bits` and `middle` (2,), which is scratch memory,
    as depths.
    """
    # The median, and not the mean: at an edge or near a multipath return the samples of a cell are
    # of two echoes, and their mean is a depth at which nothing stands. The intensity is averaged
    # over the samples of the median's echo only, so that it belongs to the same surface.
    middle[0], middle[1] = _two_from(bits, np.int32((valid - np.int32(1)) >> 1))
    depth = middle_m[0] if valid % 2 else (middle_m[0] + middle_m[1]) / np.float32(2.0)
    mean = _mean_near(bits, samples_m, counts, depth, np.float32(WINNER_SPREAD_M))
    # With an even count the two middle samples may be of two echoes, and no sample near their mean:
    # then average over all valid ones.
    if np.isnan(mean):
        mean = _mean_near(bits, samples_m, counts, np.float32(0), np.float32(np.inf))
    return depth, mean


Scratch = tuple[Int32, Float32, Int32, Float32, NDArray[np.uint8]]
"""Memory for the samples of one cell: bits and the same as depths, those of the two in the middle,
and counts.
"""


def scratch_memory(samples: int) -> Scratch:
    """Return memory for cells of up to that many samples; compiled functions compile what they
    allocate.
    """
    bits = np.empty(samples, np.int32)
    middle = np.empty(2, np.int32)
    return bits, bits.view(np.float32), middle, middle.view(np.float32), np.empty(samples, np.uint8)


# Without the interpreter's lock, so that another thread can read the next frame.
@numba.njit(cache=True, error_model="numpy", nogil=True)
def _reduce_cells(
    depth_bits: Int32,
    ir: NDArray[np.uint8],
    row_edges: NDArray[np.int64],
    column_edges: NDArray[np.int64],
    scratch: Scratch,
    depth: Float32,
    intensity: Float32,
) -> None:
    """Fill in depth and intensity of every cell with valid samples."""
    bits, samples_m, middle, middle_m, counts = scratch
    rows, columns = depth.shape
    for i in range(rows):
        top = row_edges[i]
        bottom = row_edges[i + 1]
        for j in range(columns):
            left = column_edges[j]
            right = column_edges[j + 1]
            n = (bottom - top) * (right - left)
            valid = _gather(
                depth_bits[top:bottom, left:right], ir[top:bottom, left:right], bits[:n], counts[:n]
            )
            if valid == 0:
                continue
            found = reduce_cell(bits[:n], samples_m[:n], counts[:n], valid, middle, middle_m)
            depth[i, j], intensity[i, j] = found


def _edges(pixels: int, cells: int) -> NDArray[np.int64]:
    """Return the first pixel of each cell, and one past the last: a pixel belongs to the cell that
    holds its center.
    """
    # Pixel p has its center at (p + 1/2) cells / pixels, so cell k begins with the least p >= k
    # pixels / cells - 1/2.
    return np.ceil(np.arange(cells + 1) * pixels / cells - 0.5).astype(np.int64).clip(0, pixels)


def maps_from_frame(frame: Frame) -> LidarMaps:
    """Reduce the full field of a frame to (64, 80) cells: median depth, and mean intensity near
    that median.

    Raises ValueError if the depth and the infrared image differ in shape.
    """
    # The compiled loop reads both images at the same places, without a check of its own.
    if frame.ir.shape != frame.depth_m.shape:
        raise ValueError(
            f"a frame has a depth image {frame.depth_m.shape} and an infrared image"
            f" {frame.ir.shape}: they must have one shape"
        )
    height, width = frame.depth_m.shape
    max_samples = ceil(height / MAP_ROWS + 1) * ceil(width / MAP_COLUMNS + 1)
    edges = _edges(height, MAP_ROWS), _edges(width, MAP_COLUMNS)
    depth = np.full((MAP_ROWS, MAP_COLUMNS), np.nan, np.float32)
    intensity = np.zeros((MAP_ROWS, MAP_COLUMNS), np.float32)
    scratch = scratch_memory(max_samples)
    depth_bits = frame.depth_m.astype(np.float32, copy=False).view(np.int32)
    _reduce_cells(depth_bits, frame.ir, *edges, scratch, depth, intensity)
    return LidarMaps(depth, intensity, ~np.isnan(depth))


class MapMean:
    """Running mean of the last `frames` maps, per cell over those in which it was valid, in
    constant time per frame.

    Stateful: feed maps in order, from one thread.
    """

    # A running sum adds the new value and subtracts the old one, without error as long as sums fit
    # the 53 bits of float64: float32 depths of at least 2^-15 m, of 24 bits each, are multiples of
    # 2^-38 m, and sums of such multiples are exact below 2^15 m.

    def __init__(self, frames: int) -> None:
        shape = MAP_ROWS, MAP_COLUMNS
        self._last = np.zeros((frames, 2, *shape), np.float32)
        """Depth and intensity of each frame, 0 where invalid."""
        self._valid = np.zeros((frames, *shape), np.bool_)
        self._sums = np.zeros((2, *shape))
        self._count = np.zeros(shape, np.int64)
        self._next = 0

    def add(self, maps: LidarMaps) -> LidarMaps:
        """Add the maps of a frame, drop the oldest beyond `frames`, and return the mean."""
        if len(self._last) == 1:
            return maps
        last = self._last[self._next]
        valid = self._valid[self._next]
        self._sums -= last
        self._count -= valid
        last[:] = np.where(maps.valid, (maps.depth_m, maps.intensity), np.float32(0.0))
        valid[:] = maps.valid
        self._sums += last
        self._count += valid
        self._next = (self._next + 1) % len(self._last)
        has_samples = self._count > 0
        depth_m, intensity = (self._sums / np.maximum(self._count, 1)).astype(np.float32)
        depth_m[~has_samples] = np.nan
        intensity[~has_samples] = 0.0
        return LidarMaps(depth_m, intensity, has_samples)
