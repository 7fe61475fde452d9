"""Self-occlusion V: visibility of wall points from the patches of the hidden object.

The object is opaque from its depth map away from the wall. Take a patch at depth z and a wall point
u cells away along the major axis of the direction. The leg falls linearly from z to 0 over u cells,
so after k cells it is at depth z - k z / u. A surface of depth z' there blocks it if z' + bias < z
- k z / u, that is (z - z' - bias) / k > z / u. So each direction has one number, its horizon h =
max_k (z - z' - bias) / k, and a leg is free if z >= u h. This is the horizon of height-field
shading (Max, "Horizon mapping", 1988), taken per cell.

The reference walks the exact direction of every leg. The fast backends look up lower and upper
bounds of h over sectors of directions (`horizon_table`) and walk only the legs between the bounds:
the same answer for a fraction of the walks.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64, Int64
from numpy.typing import NDArray

from nlos_cam.frames import inner
from nlos_cam.objects import cell_centers_m
from nlos_cam.render.patches import cell_pitch_m

FACES = 4
"""Major directions +columns, -columns, +rows, -rows, each with its own sectors."""
BIAS_CELLS = 0.25
"""Height in cells by which a cell must rise above a leg to block it: less is the roughness of the
grid itself.
"""
ROUNDING = 1e-5
"""Relative widening of the bounds, so that a leg on a bound in float32 is walked in float64."""
TOUCH = np.float32(1e-5)
"""Height in meters per cell, above the rounding of float32, by which a step may fail to matter and
is walked.
"""


class HeightField(NamedTuple):
    """Depth map laid out for walks along rays. NaN is background, which neither shades nor receives
    light.
    """

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
    ends = (
        (int(rows.min()), int(rows.max()), int(columns.min()), int(columns.max()))
        if rows.size
        else (0, 0, 0, 0)
    )
    pitch = cell_pitch_m(box, depth_m.shape)
    return HeightField(
        np.array(depth_m, np.float64, order="C"),
        float(x_m[0]),
        float(y_m[0]),
        *pitch,
        nearest,
        *ends,
        shades,
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


@inner()
def _depth(field: HeightField, along: int, across: int, along_columns: bool) -> float:
    """Return the depth of a cell, given along and across the walk; NaN beyond the surface's ends
    across it.
    """
    first = field.first_row if along_columns else field.first_column
    last = field.last_row if along_columns else field.last_column
    if across < first or across > last:
        return np.nan
    return field.depth_m[across, along] if along_columns else field.depth_m[along, across]


@inner()
def _between(field: HeightField, along: int, across: float, along_columns: bool) -> float:
    """Return the depth between two neighbors across the walk, interpolated; the nearer decides if
    one is background.
    """
    low = int(np.floor(across))
    share = across - low
    # Depth is linear between two centers; an interpolation with background has no depth at all.
    near = _depth(field, along, low, along_columns)
    far = _depth(field, along, low + 1, along_columns)
    if np.isnan(near) or np.isnan(far):
        return near if share < 0.5 else far
    return near + share * (far - near)


@inner()
def _steps(field: HeightField, start: int, forward: bool, along_columns: bool) -> int:
    """Return the number of steps along an axis before the walk leaves the surface."""
    first = field.first_column if along_columns else field.first_row
    last = field.last_column if along_columns else field.last_row
    return last - start if forward else start - first


@numba.njit(cache=True)
def blocked(
    field: HeightField,
    row: int,
    column: int,
    depth_m: float,
    u: float,
    v: float,
    first: int = 1,
    last: int = 1 << 30,
) -> bool:
    """Return whether the object blocks the leg from a cell to the wall point u columns and v rows
    away.

    Steps before `first` and after `last` are known not to block it.
    """
    along_columns = abs(u) >= abs(v)
    major, minor = (u, v) if along_columns else (v, u)
    if abs(major) < 1e-9:
        return False
    start, across = (column, row) if along_columns else (row, column)
    tilt = minor / abs(major)
    step = 1 if major > 0 else -1
    limit = depth_m / abs(major)
    bias = bias_m(field)
    # h = max_k (z - z' - bias) / k against z / u: the leg is blocked as soon as one term is larger.
    for k in range(first, min(_steps(field, start, major > 0, along_columns), last) + 1):
        # The highest surface there is cannot reach the leg any more, nor can any farther away: 1 /
        # k only falls.
        if (depth_m - field.nearest_m - bias) / k <= limit:
            return False
        depth = _between(field, start + k * step, across + k * tilt, along_columns)
        # Background is NaN, which compares false.
        if (depth_m - depth - bias) / k > limit:
            return True
    return False


@numba.njit(cache=True)
def visible(field: HeightField, row: int, column: int, point: Float64, x: float, y: float) -> bool:
    """Return whether a wall point (x, y) and the center (3,) of a patch see each other past the
    rest of the object.
    """
    if not field.shades:
        return True
    return not blocked(
        field,
        row,
        column,
        point[2],
        (x - point[0]) / field.pitch_x_m,
        (point[1] - y) / field.pitch_y_m,
    )


@numba.njit(cache=True)
def segment_blocked(
    field: HeightField,
    row: int,
    column: int,
    depth_m: float,
    to_row: int,
    to_column: int,
    to_depth_m: float,
) -> bool:
    """Return whether the object stands between two of its own cells."""
    across = to_column - column
    down = to_row - row
    along_columns = abs(across) >= abs(down)
    start, start_across = (column, row) if along_columns else (row, column)
    major, minor = (across, down) if along_columns else (down, across)
    count = abs(major)
    bias = bias_m(field)
    # Both ends are cells of the surface itself, so only the cells between them count.
    for k in range(1, count):
        depth = _between(
            field, start + k * major // count, start_across + k * minor / count, along_columns
        )
        # Along a segment between two cells the limit is the segment's own depth, interpolated, in
        # place of z - k z / u.
        if depth < depth_m + (to_depth_m - depth_m) * k / count - bias:
            return True
    return False


@numba.njit(
    cache=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"}, inline="always"
)
def _meet(
    row: Float32,
    offset: int,
    share: np.float32,
    over: bool,
    rise_m: Float32,
    last: Float32,
    k: np.float32,
    bounds: Float32,
) -> None:
    """Update a sector's bounds (4, n), those of `_line`, by the cells k steps on, for n neighbors
    at once.

    `last` (2, n) holds the smallest and the largest depth in the direction where the sector begins;
    it is replaced by those where it ends, `offset` cells across and a share of the next one. `over`
    is True if it crosses a cell.
    """
    nothing = np.float32(np.inf)
    inverse = np.float32(1) / k
    least = last[0]
    most = last[1]
    low = bounds[0]
    high = bounds[1]
    first = bounds[2]
    until = bounds[3]
    near = row[offset : offset + len(rise_m)]
    beyond = row[offset + 1 : offset + 1 + len(rise_m)]
    for c in range(len(rise_m)):
        a = near[c]
        b = beyond[c]
        until_now = until[c]
        # Next to background the nearer of both cells stands for itself: either may be the smallest,
        # none the largest.
        gap = (a == nothing) | (b == nothing)
        between = a + share * (b - a)
        smallest = min(a, b) if gap else between
        largest = nothing if gap else between
        least_now = least[c]
        most_now = most[c]
        before = low[c]
        across = a if over else smallest
        deepest = a if over else largest
        above = (rise_m[c] - min(least_now, smallest, across)) * inverse
        high[c] = max(high[c], above)
        lowest = max(before, (rise_m[c] - max(most_now, largest, deepest)) * inverse)
        low[c] = lowest
        # A step matters to a leg between the bounds if it may rise above the wall and above the
        # lower bound.
        matters = k if above > -TOUCH else nothing
        first[c] = min(first[c], matters)
        until[c] = k if above > lowest - TOUCH else until_now
        least[c] = smallest
        most[c] = largest


@inner(error_model="numpy")
def _line(
    cells: Float32, margin: int, start: int, step: int, steps: int, rise_m: Float32, sectors: int
) -> Float32:
    """Return bounds (sectors, 4, n) of the horizons of n neighbors on a line: low, high, first and
    last step to walk.

    `cells` (lines, margin + n + ...) is the depth map with inf for background, neighbors side by
    side.
    """
    count = len(rise_m)
    bounds = np.zeros((sectors, 4, count), np.float32)
    bounds[:, 2] = np.inf
    last = np.empty((2, count), np.float32)
    # After k cells a sector from a to b covers k a to k b across. Every direction in it has at
    # least the term of the largest depth there and at most that of the smallest; the maximum over k
    # keeps both orders. Depth is linear between cells, so its extremes lie in the sector's two
    # directions and at the cells in between.
    for k in range(1, steps + 1):
        row = cells[start + k * step]
        before = 0
        for sector in range(sectors + 1):
            across = k * (2.0 * sector / sectors - 1.0)
            offset = int(np.floor(across))
            if sector == 0:
                # Before the first sector: what its edge adds is true of the first one too.
                last[:] = np.inf
            for cell in range(before + 1, offset if sector else before):
                for c in range(count):
                    depth = row[margin + cell + c]
                    last[0, c] = min(last[0, c], depth)
                    last[1, c] = max(last[1, c], depth)
            over = sector > 0 and offset > before
            share = np.float32(across - offset)
            _meet(
                row,
                margin + offset,
                share,
                over,
                rise_m,
                last,
                np.float32(k),
                bounds[max(sector - 1, 0)],
            )
            before = offset
    return bounds


@inner()
def _side_by_side(
    field: HeightField, rows: Int64, columns: Int64, margin: int
) -> tuple[Float32, Int64]:
    """Return depths (2, n, n + 2 margin), inf for background, and the patch in each cell (2, n, n),
    -1 for none.

    Of both axes: first by column with rows side by side, then by row with columns side by side.
    """
    size = len(field.depth_m)
    cells = np.full((2, size, size + 2 * margin), np.inf, np.float32)
    patch = np.full((2, size, size), -1)
    for s in range(len(rows)):
        patch[0, columns[s], rows[s]] = patch[1, rows[s], columns[s]] = s
    for i in range(size):
        for j in range(size):
            if not np.isnan(field.depth_m[i, j]):
                cells[0, j, margin + i] = cells[1, i, margin + j] = field.depth_m[i, j]
    return cells, patch


@numba.njit(cache=True, error_model="numpy", parallel=True)
def horizon_table(
    field: HeightField, rows: Int64, columns: Int64, depth_m: Float64, reach: Float64, sectors: int
) -> tuple[Float32, Float32, NDArray[np.uint8]]:
    """Return lower and upper bounds (n, FACES * sectors) of the horizons of patches, for every
    sector of directions.

    With them, first and last step (n, FACES * sectors, 2) of the walk of a leg between its bounds.
    `reach` (n,) is the longest leg to the wall in cells: horizons that no leg can meet are left
    out. The patches of a row or column go together, as a step in a direction takes all of them to
    neighbors again.
    """
    size = len(field.depth_m)
    patches = len(rows)
    low = np.zeros((patches, FACES * sectors), np.float32)
    high = np.zeros((patches, FACES * sectors), np.float32)
    walk = np.zeros((patches, FACES * sectors, 2), np.uint8)
    margin = size + 2
    cells, patch = _side_by_side(field, rows, columns, margin)
    # Depths are float32 here: bounds give way by more than their rounding.
    slack_m = np.float32(1e-6 * depth_m.max())
    # A line of cells is one task: its patches share every row of neighbors that a step leads to.
    for line in numba.prange(2 * size):
        axis = line // size
        start = line % size
        some = np.flatnonzero(patch[axis, start] >= 0)
        if not len(some):
            continue
        first = some[0]
        which = patch[axis, start]
        rise_m = np.zeros(some[-1] + 1 - first, np.float32)
        steps = 0.0
        for c in some:
            s = which[c]
            above_m = depth_m[s] - bias_m(field)
            rise_m[c - first] = above_m
            # No surface is nearer to the wall than nearest_m: after k steps a horizon is at most
            # (above - nearest) / k, and below z / reach it blocks no leg that ends on the wall.
            steps = max(steps, (above_m - field.nearest_m) * reach[s] / depth_m[s])
        for back in range(2):
            count = int(min(_steps(field, start, back == 0, axis == 0), steps))
            bounds = _line(cells[axis], margin + first, start, 1 - 2 * back, count, rise_m, sectors)
            for c in some:
                s = which[c]
                k = (2 * axis + back) * sectors
                for sector in range(sectors):
                    below, above, begin, end = bounds[sector, :, c - first]
                    low[s, k + sector] = max(below - slack_m, 0) * (1 - ROUNDING)
                    high[s, k + sector] = (above + slack_m) * (1 + ROUNDING)
                    walk[s, k + sector, 0] = min(begin, 255)
                    walk[s, k + sector, 1] = end
    return low, high, walk
