"""What a camera yields (Frame) and what the networks eat (LidarMaps), both in SI units."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil

import numba
import numpy as np
from nlos_calibration.projection import Intrinsics
from numpy.typing import NDArray

MAP_ROWS, MAP_COLUMNS = 64, 80
OBJECT_PIXELS = 64
WINNER_SPREAD_M = 0.01
"""Samples of a cell this close to its median depth count towards its intensity: a plain mean would mix winners."""

Float32 = NDArray[np.float32]


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


@numba.njit(cache=True)
def _reduce_cells(
    depth_m: Float32,
    ir: NDArray[np.uint8],
    row_edges: NDArray[np.int64],
    column_edges: NDArray[np.int64],
    most: int,
) -> tuple[Float32, Float32]:
    rows, columns = row_edges.size - 1, column_edges.size - 1
    depth, intensity = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), np.float32)
    samples, counts = np.empty(most, np.float32), np.empty(most, np.float32)
    for i in range(rows):
        for j in range(columns):
            n = 0
            for r in range(row_edges[i], row_edges[i + 1]):
                for c in range(column_edges[j], column_edges[j + 1]):
                    if 0.0 < depth_m[r, c] < np.inf:  # false for NaN too
                        samples[n], counts[n] = depth_m[r, c], ir[r, c]
                        n += 1
            if n == 0:
                continue
            median = np.median(samples[:n])
            total, near = np.float32(0.0), 0
            for k in range(n):
                if abs(samples[k] - median) <= WINNER_SPREAD_M:
                    total += counts[k]
                    near += 1
            depth[i, j] = median
            intensity[i, j] = total / near if near else counts[:n].mean()
    return depth, intensity


def _edges(pixels: int, cells: int) -> NDArray[np.int64]:
    """The first pixel of each cell, and one past the last: a pixel belongs to the cell that holds its centre."""
    return np.ceil(np.arange(cells + 1) * pixels / cells - 0.5).astype(np.int64).clip(0, pixels)


def maps_from_frame(frame: Frame) -> LidarMaps:
    """Reduce the full field of a frame to the (64, 80) cells: median depth, mean intensity near that median."""
    height, width = frame.depth_m.shape
    most = ceil(height / MAP_ROWS + 1) * ceil(width / MAP_COLUMNS + 1)
    edges = _edges(height, MAP_ROWS), _edges(width, MAP_COLUMNS)
    depth, intensity = _reduce_cells(frame.depth_m, frame.ir, *edges, most)
    return LidarMaps(depth, intensity, ~np.isnan(depth))
