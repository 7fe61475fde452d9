"""Self-occlusion V: visibility of wall points from the patches of the hidden object.

The object is opaque from its depth map away from the wall. Take a patch at depth z and a wall point u cells away along
the major axis of the direction. The leg falls linearly from z to 0 over u cells, so after k cells it is at depth
z - k z / u. A surface of depth z' there blocks it if z' + bias < z - k z / u, that is (z - z' - bias) / k > z / u.
So each direction has one number, its horizon h = max_k (z - z' - bias) / k, and a leg is free if z >= u h. This is the
horizon of height-field shading (Max, "Horizon mapping", 1988), taken per cell.

The reference walks the exact direction of every leg. The fast backends look up lower and upper bounds of h over sectors
of directions (`horizon_table`) and walk only the legs between the bounds: the same answer for a fraction of the walks.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64, Int64
from numpy.typing import NDArray

from nlos_cam.objects import cell_centers_m
from nlos_cam.render.patches import cell_pitch_m

FACES = 4
"""Major directions +columns, -columns, +rows, -rows, each with its own sectors."""
BIAS_CELLS = 0.25
"""Height in cells by which a cell must rise above a leg to block it: less is the roughness of the grid itself."""
ROUNDING = 1e-5
"""Relative widening of the bounds, so that a leg on a bound in float32 is walked in float64."""


class HeightField(NamedTuple):
    """Depth map laid out for walks along rays. NaN is background, which neither shades nor receives light."""

    depth_m: Float64
    """(n, n)."""
    x_0_m: float
    """Wall x of the centers in column 0, and y of those in row 0."""
    y_0_m: float
    pitch_x_m: float
    pitch_y_m: float
    nearest_m: float
    """Smallest depth: nothing rises above this."""
    first_row: int
    """Ends of the rows and columns that hold a surface."""
    last_row: int
    first_column: int
    last_column: int
    shades: bool
    """False skips all walks: the plan left self-occlusion out."""


def height_field(depth_m: NDArray[np.floating], box: ObjectBox, *, shades: bool) -> HeightField:
    """Return a depth map (n, n) over its box, laid out for walks."""
    x_m, y_m = cell_centers_m(box, len(depth_m))
    rows, columns = np.nonzero(~np.isnan(depth_m))
    nearest = float(np.nanmin(depth_m)) if rows.size else np.inf
    ends = (int(rows.min()), int(rows.max()), int(columns.min()), int(columns.max())) if rows.size else (0, 0, 0, 0)
    pitch = cell_pitch_m(box, depth_m.shape)
    return HeightField(
        np.array(depth_m, np.float64, order="C"), float(x_m[0]), float(y_m[0]), *pitch, nearest, *ends, shades
    )


@numba.njit(cache=True)
def occluded(ax: float, az: float, bx: float, bz: float, edge_x: float, edge_z: float) -> bool:
    """Return whether the half plane x = edge_x, z >= edge_z cuts the segment from a to b."""
    if (ax - edge_x) * (bx - edge_x) >= 0:
        return False
    # Height of the segment where it crosses the plane of the edge.
    return az + (edge_x - ax) / (bx - ax) * (bz - az) >= edge_z


@numba.njit(cache=True)
def bias_m(field: HeightField) -> float:
    """Return the height in meters by which a cell must rise above a leg to block it."""
    return BIAS_CELLS * max(field.pitch_x_m, field.pitch_y_m)


@numba.njit(cache=True)
def _depth(field: HeightField, along: int, across: int, along_columns: bool) -> float:
    """Return the depth of a cell, given along and across the walk; NaN beyond the surface's ends across it."""
    first = field.first_row if along_columns else field.first_column
    last = field.last_row if along_columns else field.last_column
    if across < first or across > last:
        return np.nan
    return field.depth_m[across, along] if along_columns else field.depth_m[along, across]


@numba.njit(cache=True)
def _between(field: HeightField, along: int, across: float, along_columns: bool) -> float:
    """Return the depth between two neighbors across the walk, interpolated; the nearer decides if one is background."""
    low = int(np.floor(across))
    share = across - low
    near, far = _depth(field, along, low, along_columns), _depth(field, along, low + 1, along_columns)
    if np.isnan(near) or np.isnan(far):
        return near if share < 0.5 else far
    return near + share * (far - near)


@numba.njit(cache=True)
def _steps(field: HeightField, start: int, forward: bool, along_columns: bool) -> int:
    """Return the number of steps along an axis before the walk leaves the surface."""
    first = field.first_column if along_columns else field.first_row
    last = field.last_column if along_columns else field.last_row
    return last - start if forward else start - first


@numba.njit(cache=True)
def blocked(field: HeightField, row: int, column: int, depth_m: float, u: float, v: float) -> bool:
    """Return whether the object blocks the leg from a cell to the wall point u columns and v rows away."""
    along_columns = abs(u) >= abs(v)
    major, minor = (u, v) if along_columns else (v, u)
    if abs(major) < 1e-9:
        return False
    start, across = (column, row) if along_columns else (row, column)
    tilt, step = minor / abs(major), 1 if major > 0 else -1
    limit, bias = depth_m / abs(major), bias_m(field)
    for k in range(1, _steps(field, start, major > 0, along_columns) + 1):
        # The highest surface there is cannot reach the leg any more, nor can any farther away: 1 / k only falls.
        if (depth_m - field.nearest_m - bias) / k <= limit:
            return False
        if (depth_m - _between(field, start + k * step, across + k * tilt, along_columns) - bias) / k > limit:
            return True
    return False


@numba.njit(cache=True)
def visible(field: HeightField, row: int, column: int, point: Float64, x: float, y: float) -> bool:
    """Return whether a wall point (x, y) and the center (3,) of a patch see each other past the rest of the object."""
    if not field.shades:
        return True
    return not blocked(field, row, column, point[2], (x - point[0]) / field.pitch_x_m, (point[1] - y) / field.pitch_y_m)


@numba.njit(cache=True)
def segment_blocked(
    field: HeightField, row: int, column: int, depth_m: float, to_row: int, to_column: int, to_depth_m: float
) -> bool:
    """Return whether the object stands between two of its own cells."""
    across, down = to_column - column, to_row - row
    along_columns = abs(across) >= abs(down)
    start, start_across = (column, row) if along_columns else (row, column)
    major, minor = (across, down) if along_columns else (down, across)
    count, bias = abs(major), bias_m(field)
    for k in range(1, count):
        depth = _between(field, start + k * major // count, start_across + k * minor / count, along_columns)
        # Along a segment between two cells the limit is the segment's own depth, interpolated, in place of z - k z / u.
        if depth < depth_m + (to_depth_m - depth_m) * k / count - bias:
            return True
    return False


@numba.njit(cache=True)
def _bounds_at(
    field: HeightField, along: int, across_a: float, across_b: float, along_columns: bool
) -> tuple[float, float]:
    """Return the smallest and the largest depth of `_between` from across_a to across_b; the latter NaN at a gap."""
    a, b = _between(field, along, across_a, along_columns), _between(field, along, across_b, along_columns)
    # Interpolation is linear between cells, so its extremes lie at both ends and at the cells in between. Cells within
    # half a cell of the ends count too, as next to background the nearer neighbor stands for itself.
    first, last = int(np.ceil(across_a - 0.5)), int(np.floor(across_b + 0.5))
    gap = np.isnan(a) or np.isnan(b)
    for across in range(first, last + 1):
        gap = gap or np.isnan(_depth(field, along, across, along_columns))
    least, most = np.inf, -np.inf
    for depth in (a, b):
        if not np.isnan(depth):
            least, most = min(least, depth), max(most, depth)
    for across in range(first, last + 1):
        depth = _depth(field, along, across, along_columns)
        if not np.isnan(depth) and (gap or across_a <= across <= across_b):
            least, most = min(least, depth), max(most, depth)
    return least, np.nan if gap else most


@numba.njit(cache=True)
def _horizons(
    field: HeightField, row: int, column: int, depth_m: float, face: int, a: float, b: float, reach: float
) -> tuple[float, float]:
    """Return bounds of the horizon over a sector: directions that go a to b cells across per cell along the axis."""
    along_columns, forward = face < 2, face % 2 == 0
    start, across = (column, row) if along_columns else (row, column)
    low, high, step, bias = 0.0, depth_m / reach, 1 if forward else -1, bias_m(field)
    # After k cells the sector covers k a to k b across. Every direction in it has at least the term of the largest
    # depth there and at most that of the smallest; the maximum over k keeps both orders. Horizons below z / reach block
    # no leg that ends on the wall, so `high` starts there.
    for k in range(1, _steps(field, start, forward, along_columns) + 1):
        if (depth_m - field.nearest_m - bias) / k <= max(low, depth_m / reach):
            break
        least, most = _bounds_at(field, start + k * step, across + k * a, across + k * b, along_columns)
        high = max(high, (depth_m - least - bias) / k)
        if not np.isnan(most):
            low = max(low, (depth_m - most - bias) / k)
    return low, high


@numba.njit(cache=True, parallel=True)
def horizon_table(
    field: HeightField, rows: Int64, columns: Int64, depth_m: Float64, reach: Float64, sectors: int
) -> tuple[Float32, Float32]:
    """Return lower and upper bounds (n, FACES * sectors) of the horizons of patches, for every sector of directions.

    `reach` (n,) is the longest leg to the wall in cells: horizons that no leg can meet are left out.
    """
    low, high = np.empty((len(rows), FACES * sectors), np.float32), np.empty((len(rows), FACES * sectors), np.float32)
    for s in numba.prange(len(rows)):
        for face in range(FACES):
            for sector in range(sectors):
                a, b = 2.0 * sector / sectors - 1.0, 2.0 * (sector + 1) / sectors - 1.0
                below, above = _horizons(field, rows[s], columns[s], depth_m[s], face, a, b, reach[s])
                k = face * sectors + sector
                low[s, k], high[s, k] = below * (1 - ROUNDING), above * (1 + ROUNDING)
    return low, high
