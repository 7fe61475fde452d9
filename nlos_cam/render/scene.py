"""What is rendered at one instant: a rig and the depth map of what is hidden."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import ObjectBox, Rig
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS, Float32
from nlos_cam.objects.depth_image import cell_centres_m, object_box

Array = NDArray[np.float64]

JUMP_M = 0.02
"""Neighbours further apart in depth than this are not one surface: beta (S3) must not join them by a curtain."""
CLEARANCE_M = 0.02
"""Two diagonals of the default wall cell: nearer to the wall, 1/d^2 from a patch's centre is no longer its average."""


@dataclass(frozen=True)
class Patches:
    """The active cells of a hidden surface, one row each: centre, normal towards the wall, beta (S3)."""

    point_m: Array
    """(n, 3)."""
    normal: Array
    """(n, 3), unit."""
    beta: Array
    """(n,); true area over projected area."""
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    cell_m2: float
    """S_unit_target: projected area of a cell."""


@dataclass(frozen=True)
class Scene:
    """One instant. Raises SceneError where the object cannot be rendered."""

    rig: Rig
    object_depth_m: Float32 | None = None
    """(64, 64) over the rig's object box, NaN for background; None hides nothing."""

    def __post_init__(self) -> None:
        depth = self.object_depth_m
        if depth is None:
            return
        _ = self.box  # refuse a rig that has none
        if depth.shape != (OBJECT_PIXELS, OBJECT_PIXELS):
            raise SceneError(f"object depth has shape {depth.shape}: it must be ({OBJECT_PIXELS}, {OBJECT_PIXELS})")
        surface = depth[~np.isnan(depth)]
        if surface.size and not (np.isfinite(surface).all() and surface.min() >= CLEARANCE_M):
            raise SceneError(
                f"object depth runs from {surface.min():.3g} to {surface.max():.3g} m: every surface must be finite "
                f"and at least {CLEARANCE_M} m off the wall (use NaN for background)",
            )

    @property
    def cell_intrinsics(self) -> Intrinsics:
        """One beam through the middle of each map cell."""
        return self.rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)

    @property
    def box(self) -> ObjectBox:
        """The object box; SceneError where the rig has none."""
        return object_box(self.rig)

    @cached_property
    def patches(self) -> Patches | None:
        """The hidden surface as patches; None where nothing is hidden."""
        if self.object_depth_m is None or np.isnan(self.object_depth_m).all():
            return None
        return _patches(self.object_depth_m.astype(np.float64), self.box)


def _slope(depth: Array, axis: int, pitch_m: float) -> Array:
    """Forward difference along an axis; backward at an edge or a jump; 0 where no neighbour is the same surface."""
    padding = [(1, 1) if a == axis else (0, 0) for a in range(2)]
    step = np.diff(np.pad(depth, padding, constant_values=np.nan), axis=axis)
    step = np.where(np.abs(step) <= JUMP_M, step, np.nan)
    forward = np.take(step, range(1, step.shape[axis]), axis)
    backward = np.take(step, range(step.shape[axis] - 1), axis)
    return np.nan_to_num(np.where(np.isnan(forward), backward, forward), nan=0.0) / pitch_m


def _patches(depth: Array, box: ObjectBox) -> Patches:
    x_m, y_m = cell_centres_m(box)
    pitch_x, pitch_y = x_m[1] - x_m[0], y_m[0] - y_m[1]
    row, column = np.nonzero(~np.isnan(depth))
    slope_x = _slope(depth, 1, pitch_x)[row, column]
    slope_y = -_slope(depth, 0, pitch_y)[row, column]  # rows run along -y
    beta = np.sqrt(1 + slope_x**2 + slope_y**2)  # S3, divided through by dx dy
    normal = np.stack([slope_x, slope_y, -np.ones_like(beta)], axis=-1) / beta[:, None]
    point = np.stack([x_m[column], y_m[row], depth[row, column]], axis=-1)
    return Patches(point, normal, beta, row, column, pitch_x * pitch_y)
