"""What a camera yields (Frame) and what the networks eat (LidarMaps), both in SI units.

The running mean of maps over the last frames, per cell over those in which it was valid.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil

import numba
import numpy as np
from nlos_calibration import Intrinsics
from nlos_calibration.arrays import Float32, Int32
from numpy.typing import NDArray

MAP_ROWS, MAP_COLUMNS = 64, 80
OBJECT_PIXELS = 64
WINNER_SPREAD_M = 0.01
"""Samples of a cell this close to its median depth count towards its intensity: a plain mean would mix winners."""

Real = float | np.float32


@dataclass(frozen=True)
class Frame:
    """One synchronised frame of a lidar: depth, infrared and confidence of one instant."""

    depth_m: Float32
    """(height, width); distance along the optical axis, NaN where there is no return."""
    ir: NDArray[np.uint8]
    """(height, width); intensity of the return, 255 is saturated."""
    confidence: NDArray[np.uint8]
    """(height, width); 0 (low) to 15 (high)."""
    timestamp_s: float
    frame_number: int
    intrinsics: Intrinsics
    settings: Mapping[str, float] = field(default_factory=dict[str, float])
    """The device's options as read back when streaming began."""
    truth_depth_m: Float32 | None = None
    """(64, 64) hidden depth over the object box, where the camera knows it (a simulated one does)."""


@dataclass(frozen=True)
class LidarMaps:
    """A frame reduced to the (64, 80) cells that the networks eat; row 0 on top, column 79 far from the foot."""

    depth_m: Float32
    """(64, 80); NaN where a cell has no valid sample."""
    intensity: Float32
    """(64, 80); in IR counts, 0 where a cell has no valid sample."""
    valid: NDArray[np.bool_]
    """(64, 80)."""


NO_SAMPLE = np.int32(0x7FFFFFFF)
"""Depth is compared by its bits: those of positive floats are ordered as the floats are, and this is beyond them."""
INFINITE_BITS = np.int32(0x7F800000)


@numba.njit(cache=True, error_model="numpy")
def _gather(depth_bits: Int32, ir: NDArray[np.uint8], bits: Int32, counts: NDArray[np.uint8]) -> np.int32:
    """Copy one cell's samples side by side; how many of them are a return (not NaN, 0, negative or infinite)."""
    valid, k = np.int32(0), 0
    for r in range(depth_bits.shape[0]):
        for c in range(depth_bits.shape[1]):
            sample = depth_bits[r, c]
            is_return = (sample > 0) & (sample < INFINITE_BITS)
            bits[k], counts[k] = sample if is_return else NO_SAMPLE, ir[r, c]
            valid += np.int32(is_return)
            k += 1
    return valid


@numba.njit(cache=True, error_model="numpy")
def _two_from(bits: Int32, rank: np.int32) -> tuple[np.int32, np.int32]:
    """The bits of the samples of that rank (0 is the smallest) and the next, by bisection between samples."""
    low, high = NO_SAMPLE, np.int32(0)
    for i in range(bits.size):
        low = min(low, bits[i])
        high = max(high, bits[i] if bits[i] != NO_SAMPLE else np.int32(0))
    while low < high:
        middle = low + ((high - low) >> 1)
        up_to, below, above = np.int32(0), np.int32(0), NO_SAMPLE
        for i in range(bits.size):
            is_below = bits[i] <= middle
            up_to += np.int32(is_below)
            below = max(below, bits[i] if is_below else np.int32(0))
            above = min(above, NO_SAMPLE if is_below else bits[i])
        if up_to > rank:
            high = below
        else:
            low = above
    up_to, above = np.int32(0), NO_SAMPLE
    for i in range(bits.size):
        is_below = bits[i] <= low
        up_to += np.int32(is_below)
        above = min(above, NO_SAMPLE if is_below else bits[i])
    return low, low if up_to > rank + 1 else above


@numba.njit(cache=True, error_model="numpy")
def _mean_near(bits: Int32, depth_m: Float32, counts: NDArray[np.uint8], median_m: Real, spread_m: Real) -> np.floating:
    """The mean count of the samples within `spread_m` of the median; NaN if there are none."""
    total, near = np.int32(0), np.int32(0)
    for i in range(bits.size):
        is_near = (bits[i] != NO_SAMPLE) & (abs(depth_m[i] - median_m) <= spread_m)
        near += np.int32(is_near)
        total += np.int32(counts[i]) if is_near else np.int32(0)
    return np.float32(total) / np.float32(near)


@numba.njit(cache=True, error_model="numpy", nogil=True)  # meanwhile another thread may take the next frame
def _reduce_cells(
    depth_bits: Int32,
    ir: NDArray[np.uint8],
    row_edges: NDArray[np.int64],
    column_edges: NDArray[np.int64],
    most: int,
) -> tuple[Float32, Float32]:
    rows, columns = row_edges.size - 1, column_edges.size - 1
    depth, intensity = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), np.float32)
    bits, middle, counts = np.empty(most, np.int32), np.empty(2, np.int32), np.empty(most, np.uint8)
    samples_m, middle_m = bits.view(np.float32), middle.view(np.float32)
    for i in range(rows):
        top, bottom = row_edges[i], row_edges[i + 1]
        for j in range(columns):
            left, right = column_edges[j], column_edges[j + 1]
            n = (bottom - top) * (right - left)
            valid = _gather(depth_bits[top:bottom, left:right], ir[top:bottom, left:right], bits[:n], counts[:n])
            if valid == 0:
                continue
            middle[0], middle[1] = _two_from(bits[:n], (valid - np.int32(1)) >> 1)
            depth[i, j] = middle_m[0] if valid % 2 else (middle_m[0] + middle_m[1]) / np.float32(2.0)
            mean = _mean_near(bits[:n], samples_m[:n], counts[:n], depth[i, j], np.float32(WINNER_SPREAD_M))
            # the two middle samples may lie far apart, and none near their mean
            intensity[i, j] = mean if mean == mean else _mean_near(bits[:n], samples_m[:n], counts[:n], 0.0, np.inf)  # noqa: PLR0124  NaN
    return depth, intensity


def _edges(pixels: int, cells: int) -> NDArray[np.int64]:
    """The first pixel of each cell, and one past the last: a pixel belongs to the cell that holds its centre."""
    return np.ceil(np.arange(cells + 1) * pixels / cells - 0.5).astype(np.int64).clip(0, pixels)


def maps_from_frame(frame: Frame) -> LidarMaps:
    """Reduce the full field of a frame to the (64, 80) cells: median depth, mean intensity near that median."""
    height, width = frame.depth_m.shape
    most = ceil(height / MAP_ROWS + 1) * ceil(width / MAP_COLUMNS + 1)
    edges = _edges(height, MAP_ROWS), _edges(width, MAP_COLUMNS)
    depth, intensity = _reduce_cells(frame.depth_m.view(np.int32), frame.ir, *edges, most)
    return LidarMaps(depth, intensity, ~np.isnan(depth))


MAX_SATURATED = 0.001
"""Share of infrared pixels; the L515 under-estimates depth where they are."""


def saturated_share(ir: NDArray[np.uint8]) -> float:
    """Of the pixels of an infrared image, the share that is saturated."""
    return float(np.count_nonzero(ir == SATURATED)) / ir.size


SATURATED = 255
"""The full scale of the IR's 8 bits, in counts."""


class MapMean:
    """The mean of the last maps, as many as are given, in the same time however many; NaN depth is no sample.

    Sums in float64 are of float32 depths, which are exact while the depths lie between 2^-15 m and 2^15 m over the
    number of frames: what is taken off is what was added, and no error accumulates.
    """

    def __init__(self, frames: int) -> None:
        shape = MAP_ROWS, MAP_COLUMNS
        self._last = np.zeros((frames, 2, *shape), np.float32)
        """Depth and intensity, 0 where there was none."""
        self._valid = np.zeros((frames, *shape), np.bool_)
        self._sums, self._count = np.zeros((2, *shape)), np.zeros(shape, np.int64)
        self._next = 0

    def add(self, maps: LidarMaps) -> LidarMaps:
        """Take the maps of a frame in, let go of those that have become too old, and return the mean."""
        if len(self._last) == 1:
            return maps
        last, valid = self._last[self._next], self._valid[self._next]
        self._sums -= last
        self._count -= valid
        last[:] = np.where(maps.valid, (maps.depth_m, maps.intensity), np.float32(0.0))
        valid[:] = maps.valid
        self._sums += last
        self._count += valid
        self._next = (self._next + 1) % len(self._last)
        seen = self._count > 0
        depth_m, intensity = (self._sums / np.maximum(self._count, 1)).astype(np.float32)
        return LidarMaps(np.where(seen, depth_m, np.float32(np.nan)), np.where(seen, intensity, np.float32(0.0)), seen)
