"""Self-occlusion V: does the hidden object shade a leg between one of its own patches and the wall?

The object is opaque from its depth map away from the wall. Seen from a patch at z_s, along one direction in plan, a
cell at distance t and depth z' rises to the slope (z_s - z' - bias) / t; the steepest of them is the horizon. A wall
point at distance rho lies at the slope z_s / rho, and is visible if that is not below the horizon. The reference walks
the exact direction of each leg; the fast path looks it up in a table of directions.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.rig import ObjectBox
from numpy.typing import NDArray

from nlos_cam.frames import OBJECT_PIXELS, Float32
from nlos_cam.objects.depth_image import cell_centres_m

Array = NDArray[np.float64]

DIRECTIONS = 256
BIAS_CELLS = 0.25
"""A cell must rise above the leg by this share of the pitch: less is the grid's own roughness."""
NOTHING = -1.0
"""A horizon that hides nothing: every wall point lies at a positive slope."""


class HeightField(NamedTuple):
    """A depth map laid out for walking: NaN is background, which neither shades nor receives."""

    depth_m: Array
    """(64, 64)."""
    x_0_m: float
    """Wall x of column 0; y of row 0."""
    y_0_m: float
    pitch_x_m: float
    pitch_y_m: float
    shades: bool
    """False skips the walk: the plan found that nothing can be in the way."""


def height_field(depth_m: Float32, box: ObjectBox, *, shades: bool) -> HeightField:
    """Lay out a depth map (64, 64) over its box."""
    x_m, y_m = cell_centres_m(box)
    return HeightField(depth_m.astype(np.float64), x_m[0], y_m[0], x_m[1] - x_m[0], y_m[0] - y_m[1], shades)


@numba.njit(cache=True)
def horizon(field: HeightField, point: Array, dx: float, dy: float) -> float:
    """The steepest slope that the surface reaches, seen from `point` (3,), in the plan direction (dx, dy)."""
    column, row = (point[0] - field.x_0_m) / field.pitch_x_m, (field.y_0_m - point[1]) / field.pitch_y_m
    step_c, step_r = dx / field.pitch_x_m, -dy / field.pitch_y_m
    stride = max(abs(step_c), abs(step_r))
    step_c, step_r = step_c / stride, step_r / stride
    step_m = np.sqrt((step_c * field.pitch_x_m) ** 2 + (step_r * field.pitch_y_m) ** 2)
    along_columns = abs(step_c) >= abs(step_r)
    bias = BIAS_CELLS * max(field.pitch_x_m, field.pitch_y_m)
    steepest = NOTHING
    for k in range(1, OBJECT_PIXELS):
        c, r = column + k * step_c, row + k * step_r
        along, across = (c, r) if along_columns else (r, c)
        if along < -0.5 or along > OBJECT_PIXELS - 0.5:
            break
        low = int(np.floor(across))
        near = _depth(field, along, low, along_columns)
        far = _depth(field, along, low + 1, along_columns)
        depth = _between(near, far, across - low)
        slope = (point[2] - depth - bias) / (k * step_m)
        if slope > steepest:  # noqa: PLR1730  false for NaN, which max() would keep
            steepest = slope
    return steepest


@numba.njit(cache=True)
def _depth(field: HeightField, along: float, across: int, along_columns: bool) -> float:
    exact = round(along)
    row, column = (across, exact) if along_columns else (exact, across)
    if row < 0 or column < 0 or row >= OBJECT_PIXELS or column >= OBJECT_PIXELS:
        return np.nan
    return field.depth_m[row, column]


@numba.njit(cache=True)
def _between(near: float, far: float, share: float) -> float:
    """Interpolate two neighbours; where one is background, the nearer of the two decides."""
    if np.isnan(near) or np.isnan(far):
        return near if share < 0.5 else far
    return near + share * (far - near)


@numba.njit(cache=True)
def visible(field: HeightField, point: Array, x: float, y: float) -> bool:
    """Whether the wall point (x, y) and a patch's centre (3,) see each other past the rest of the object."""
    if not field.shades:
        return True
    dx, dy = x - point[0], y - point[1]
    rho = np.sqrt(dx * dx + dy * dy)
    if rho < 1e-9:
        return True
    return point[2] >= rho * horizon(field, point, dx, dy)


@numba.njit(cache=True)
def sector(dx: float, dy: float) -> int:
    """The table's direction nearest to (dx, dy), by an angle-like number that needs no trigonometry."""
    ramp = dy / (abs(dx) + abs(dy) + 1e-30)
    turn = 1.0 + ramp if dx >= 0 else 3.0 - ramp
    return int(turn * (DIRECTIONS / 4) + 0.5) % DIRECTIONS


@numba.njit(cache=True, parallel=True)
def horizon_table(field: HeightField, points: Array) -> Float32:
    """Horizons (n, DIRECTIONS) of patches (n, 3) in every direction of `sector`."""
    table = np.full((len(points), DIRECTIONS), NOTHING, np.float32)
    if not field.shades:
        return table
    for s in numba.prange(len(points)):
        for k in range(DIRECTIONS):
            turn = k * 4.0 / DIRECTIONS
            ramp = turn - 1.0 if turn < 2 else 3.0 - turn
            dx = (1.0 - abs(ramp)) * (1.0 if turn < 2 else -1.0)
            table[s, k] = horizon(field, points[s], dx, ramp)
    return table
