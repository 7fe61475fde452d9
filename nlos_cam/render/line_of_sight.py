"""Line of sight: rays between lidar and wall that meet the hidden object, which then is not hidden
from the lidar.

The object is opaque from its depth map away from the wall: each cell of the map is a column that
starts at its depth. A ray meets a column through its front, which is the surface itself, or through
the side by which it enters the cell.
"""

from dataclasses import dataclass

import numba
import numpy as np
from nlos_calibration.arrays import Float64, Int64
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import inner
from nlos_cam.render.geometry import Beams, Relay
from nlos_cam.render.patches import slope_along
from nlos_cam.render.visibility import HeightField


@inner()
def _entry(start: float, direction: float, low: float, high: float) -> tuple[float, float]:
    """Return the ray parameters at which a ray enters and leaves the slab low <= coordinate <=
    high.
    """
    # Slab test (Kay and Kajiya 1986): start + t direction = low or high. A box is the intersection
    # of slabs, so the ray is inside from the largest entry to the smallest exit. A parallel ray is
    # inside always or never.
    if direction == 0.0:
        return (-np.inf, np.inf) if low <= start <= high else (np.inf, -np.inf)
    a = (low - start) / direction
    b = (high - start) / direction
    return min(a, b), max(a, b)


@inner()
def _first_hit(
    field: HeightField, slope: Float64, start: Float64, direction: Float64, length: float
) -> tuple[float, float, int, int]:
    """Return the length to the first column within `length`, the cosine there, and row and column
    of its cell.

    The length is inf if there is none.
    """
    # The box around all cells that hold a surface bounds the part of the ray to search.
    rows, columns = field.depth_m.shape
    left = field.x_0_m - field.pitch_x_m / 2
    top = field.y_0_m + field.pitch_y_m / 2
    first_x = left + field.first_column * field.pitch_x_m
    last_x = left + (field.last_column + 1) * field.pitch_x_m
    first_y = top - (field.last_row + 1) * field.pitch_y_m
    last_y = top - field.first_row * field.pitch_y_m
    in_x, out_x = _entry(start[0], direction[0], first_x, last_x)
    in_y, out_y = _entry(start[1], direction[1], first_y, last_y)
    t = max(in_x, in_y, 0.0)
    end = min(out_x, out_y, length)
    # The ray is linear in z: if its deeper end stays nearer to the wall than every surface, it
    # passes in front of all.
    if t < end and start[2] + (end if direction[2] > 0 else t) * direction[2] < field.nearest_m:
        return np.inf, 0.0, -1, -1
    side = abs(direction[0]) if in_x >= in_y else abs(direction[1])
    # DDA traversal (Amanatides and Woo 1987): t is where the ray enters a cell, and the next cell
    # begins at the nearer of the cell's exits in x and y. The cell is found by a point just past t,
    # so that rounding cannot repeat a cell.
    while t < end:
        middle = t + 1e-9
        column = int(np.floor((start[0] + middle * direction[0] - left) / field.pitch_x_m))
        row = int(np.floor((top - start[1] - middle * direction[1]) / field.pitch_y_m))
        if row < 0 or column < 0 or row >= rows or column >= columns:
            break
        _, next_x = _entry(
            start[0],
            direction[0],
            left + column * field.pitch_x_m,
            left + (column + 1) * field.pitch_x_m,
        )
        _, next_y = _entry(
            start[1], direction[1], top - (row + 1) * field.pitch_y_m, top - row * field.pitch_y_m
        )
        after = max(min(next_x, next_y, end), middle)
        depth = field.depth_m[row, column]  # NaN for background, which compares false
        # Already as deep as the column on entering: it is hit from the side, whose normal is along
        # x or y.
        if start[2] + t * direction[2] >= depth:
            return t, side, row, column
        # As deep before leaving the cell: it is hit from the front, whose normal is (gx, gy, -1)
        # normalized.
        if start[2] + after * direction[2] >= depth:
            gx = slope[0, row, column]
            gy = slope[1, row, column]
            facing = (direction[2] - gx * direction[0] - gy * direction[1]) / np.sqrt(
                1 + gx**2 + gy**2
            )
            return (depth - start[2]) / direction[2], abs(facing), row, column
        side = abs(direction[0]) if next_x <= next_y else abs(direction[1])
        t = after
    return np.inf, 0.0, -1, -1


@numba.njit(cache=True, parallel=True)
def first_hits(
    field: HeightField, slope: Float64, start: Float64, directions: Float64, lengths: Float64
) -> tuple[Float64, Float64, Int64, Int64]:
    """Return where rays from a point (3,) along unit directions (n, 3) meet the object before their
    lengths (n,).

    The result is length (n,), inf for no hit; cosine to the surface (n,); and its row and column
    (n,). `slope` holds dz/dx and dz/dy (2, rows, columns) of the depth map.
    """
    n = len(lengths)
    length = np.full(n, np.inf)
    cosine = np.zeros(n)
    row = np.full(n, -1)
    column = np.full(n, -1)
    for i in numba.prange(n):
        length[i], cosine[i], row[i], column[i] = _first_hit(
            field, slope, start, directions[i], lengths[i]
        )
    return length, cosine, row, column


@dataclass(frozen=True)
class DirectVisibility:
    """Parts of the object in the lidar's own line of sight."""

    beam: NDArray[np.int64]
    """(k,); flat indices of the beams that it stops."""
    length_m: Float64
    """(k,)."""
    cosine: Float64
    """(k,); to the normal of the surface hit."""
    row: NDArray[np.int64]
    """(k,); cell of the depth map that is hit."""
    column: NDArray[np.int64]
    hidden: NDArray[np.bool_]
    """(m,); relay cells from which no light gets to the lidar."""


def direct_visibility(
    beams: Beams, relay: Relay, field: HeightField, depth_m: Float64, jump_m: float
) -> DirectVisibility | None:
    """Return the beams and relay cells that the object blocks from the lidar; None if it blocks
    none.

    Raises SceneError if the lidar is inside the object.
    """
    to_cells = np.stack([relay.x_m, relay.y_m, np.zeros_like(relay.x_m)], 1) - beams.lidar_m
    directions = np.concatenate([beams.direction, to_cells / relay.length_m[:, None]])
    lengths = np.concatenate([np.nan_to_num(beams.length_m, nan=np.inf), relay.length_m])
    # Slopes change a hit's cosine alone, and most scenes have no hit: they are computed after one.
    level = np.zeros((2, *depth_m.shape))
    hit = np.isfinite(first_hits(field, level, beams.lidar_m, directions, lengths)[0])
    count = len(beams.length_m)
    if not hit.any():
        return None
    slope = np.stack(
        [
            slope_along(depth_m, 1, field.pitch_x_m, jump_m),
            -slope_along(depth_m, 0, field.pitch_y_m, jump_m),
        ]
    )
    length, cosine, row, column = first_hits(field, slope, beams.lidar_m, directions, lengths)
    if length[hit].min() <= 0:
        raise SceneError(
            f"the object surrounds the lidar, {beams.lidar_m[2]:g} m off the wall: move it or the"
            " lidar"
        )
    which = np.flatnonzero(hit[:count])
    return DirectVisibility(
        which, length[which], cosine[which], row[which], column[which], hit[count:]
    )
