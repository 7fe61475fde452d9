"""Depth maps of a few cells, each in one expression."""

from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32


def depth_map(cells: int, around_m: float = np.nan, *parts: tuple[Any, Any]) -> Float32:
    """Return a map (cells, cells) at one depth in metres; each part is an index and the depth
    there.
    """
    depth_m = np.full((cells, cells), around_m, np.float32)
    for where, there_m in parts:
        depth_m[where] = there_m
    return depth_m
