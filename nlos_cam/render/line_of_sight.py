"""Line of sight: where rays between the lidar and the wall meet the hidden object, which then is not hidden at all.

The object is opaque from its depth map away from the wall: each cell of the map is a column that starts at its depth. A
ray meets a column either through its front, the surface itself, or through the side by which it enters the cell.
"""

from dataclasses import dataclass

import numba
import numpy as np
from nlos_calibration.arrays import Float64, Int64
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.render.geometry import Beams, Relay
from nlos_cam.render.patches import slope_along
from nlos_cam.render.visibility import HeightField


@numba.njit(cache=True)
def _entry(start: float, direction: float, low: float, high: float) -> tuple[float, float]:
    """From where to where along a ray a slab lies."""
    if direction == 0.0:
        return (-np.inf, np.inf) if low <= start <= high else (np.inf, -np.inf)
    a, b = (low - start) / direction, (high - start) / direction
    return min(a, b), max(a, b)


@numba.njit(cache=True)
def _first_hit(
    field: HeightField, slope: Float64, start: Float64, direction: Float64, length: float
) -> tuple[float, float, int, int]:
    """Length to the first column within `length`, cosine there, row and column of its cell; inf where there is none."""
    rows, columns = field.depth_m.shape
    left, top = field.x_0_m - field.pitch_x_m / 2, field.y_0_m + field.pitch_y_m / 2
    first_x, last_x = left + field.first_column * field.pitch_x_m, left + (field.last_column + 1) * field.pitch_x_m
    first_y, last_y = top - (field.last_row + 1) * field.pitch_y_m, top - field.first_row * field.pitch_y_m
    in_x, out_x = _entry(start[0], direction[0], first_x, last_x)
    in_y, out_y = _entry(start[1], direction[1], first_y, last_y)
    t, end = max(in_x, in_y, 0.0), min(out_x, out_y, length)
    if t < end and start[2] + (end if direction[2] > 0 else t) * direction[2] < field.nearest_m:
        return np.inf, 0.0, -1, -1  # it passes between the object and the wall
    side = abs(direction[0]) if in_x >= in_y else abs(direction[1])
    while t < end:
        middle = t + 1e-9
        column = int(np.floor((start[0] + middle * direction[0] - left) / field.pitch_x_m))
        row = int(np.floor((top - start[1] - middle * direction[1]) / field.pitch_y_m))
        if row < 0 or column < 0 or row >= rows or column >= columns:
            break
        _, next_x = _entry(
            start[0], direction[0], left + column * field.pitch_x_m, left + (column + 1) * field.pitch_x_m
        )
        _, next_y = _entry(start[1], direction[1], top - (row + 1) * field.pitch_y_m, top - row * field.pitch_y_m)
        after = max(min(next_x, next_y, end), middle)
        depth = field.depth_m[row, column]  # NaN compares false: background stops nothing
        if start[2] + t * direction[2] >= depth:
            return t, side, row, column
        if start[2] + after * direction[2] >= depth:
            gx, gy = slope[0, row, column], slope[1, row, column]
            facing = (direction[2] - gx * direction[0] - gy * direction[1]) / np.sqrt(1 + gx**2 + gy**2)
            return (depth - start[2]) / direction[2], abs(facing), row, column
        side = abs(direction[0]) if next_x <= next_y else abs(direction[1])
        t = after
    return np.inf, 0.0, -1, -1


@numba.njit(cache=True, parallel=True)
def first_hits(
    field: HeightField, slope: Float64, start: Float64, directions: Float64, lengths: Float64
) -> tuple[Float64, Float64, Int64, Int64]:
    """Where rays from a point (3,), unit directions (n, 3), meet the object before their lengths (n,).

    Gives length (n,), inf where nothing is met; cosine to what is met (n,); and its row and column (n,). `slope` is of
    the depth map, dz/dx and dz/dy (2, rows, columns).
    """
    n = len(lengths)
    length, cosine, row, column = np.full(n, np.inf), np.zeros(n), np.full(n, -1), np.full(n, -1)
    for i in numba.prange(n):
        length[i], cosine[i], row[i], column[i] = _first_hit(field, slope, start, directions[i], lengths[i])
    return length, cosine, row, column


@dataclass(frozen=True)
class DirectVisibility:
    """What of the object stands in the lidar's own sight."""

    beam: NDArray[np.int64]
    """(k,); the beams that it stops."""
    length_m: Float64
    """(k,)."""
    cosine: Float64
    """(k,); to the normal of what is met."""
    row: NDArray[np.int64]
    """(k,); the cell of the depth map that is met."""
    column: NDArray[np.int64]
    hidden: NDArray[np.bool_]
    """(m,); the relay cells from which no light gets to the lidar."""


def look(beams: Beams, relay: Relay, field: HeightField, depth_m: Float64, jump_m: float) -> DirectVisibility | None:
    """Follow every beam, and every way from a relay cell to the lidar; None where the object is in none's way."""
    to_cells = np.stack([relay.x_m, relay.y_m, np.zeros_like(relay.x_m)], 1) - beams.lidar_m
    directions = np.concatenate([beams.direction, to_cells / relay.length_m[:, None]])
    lengths = np.concatenate([np.nan_to_num(beams.length_m, nan=np.inf), relay.length_m])
    slope = np.stack(
        [slope_along(depth_m, 1, field.pitch_x_m, jump_m), -slope_along(depth_m, 0, field.pitch_y_m, jump_m)]
    )
    length, cosine, row, column = first_hits(field, slope, beams.lidar_m, directions, lengths)
    hit, count = np.isfinite(length), len(beams.length_m)
    if not hit.any():
        return None
    if length[hit].min() <= 0:
        raise SceneError(f"the object surrounds the lidar, {beams.lidar_m[2]:g} m off the wall: move it or the lidar")
    which = np.flatnonzero(hit[:count])
    return DirectVisibility(which, length[which], cosine[which], row[which], column[which], hit[count:])
