"""Depth maps of a few cells, each in one expression, and the box around hidden objects."""

from typing import Any

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64


def depth_map(cells: int, around_m: float = np.nan, *parts: tuple[Any, Any]) -> Float32:
    """Return a map (cells, cells) at one depth in metres; each part is an index and the depth
    there.
    """
    depth_m = np.full((cells, cells), around_m, np.float32)
    for where, there_m in parts:
        depth_m[where] = there_m
    return depth_m


def inside(points_m: Float64, box: ObjectBox) -> bool:
    """Return whether all points (..., 3) in the wall frame lie in a box, up to rounding."""
    low = np.array([box.x_min_m, box.y_min_m, box.z_near_m])
    high = np.array([box.x_max_m, box.y_max_m, box.z_far_m])
    return bool(((points_m >= low - 1e-9) & (points_m <= high + 1e-9)).all())
