"""What a hidden object may stand on or before: a post below it, or a panel behind it."""

import numpy as np
from nlos_calibration.rig import ObjectBox

from nlos_cam.frames import Float32


def post(depth_m: Float32, generator: np.random.Generator) -> Float32:
    """A flat post (rows, columns) from the object's underside to the bottom of the box, NaN elsewhere."""
    surface = ~np.isnan(depth_m)
    columns = np.flatnonzero(surface.any(axis=0))
    width = max(2, round(generator.uniform(0.1, 0.35) * len(columns)))
    first = columns[0] + (len(columns) - width) // 2
    below = ~np.logical_or.accumulate(surface[::-1])[::-1] & surface.any(axis=0)
    beside = np.abs(np.arange(depth_m.shape[1]) - first - (width - 1) / 2) > width / 2
    return np.where(below & ~beside, np.nanmedian(depth_m), np.nan).astype(np.float32)


def panel(depth_m: Float32, box: ObjectBox, generator: np.random.Generator) -> Float32:
    """A panel (rows, columns) parallel to the wall, of 60 to 100 % of the box's width and height, NaN elsewhere."""
    z_m = generator.uniform(np.nanmax(depth_m), box.z_far_m)
    inside = [
        np.abs((np.arange(cells) + 0.5) / cells - 0.5) <= generator.uniform(0.6, 1.0) / 2 for cells in depth_m.shape
    ]
    return np.where(inside[0][:, None] & inside[1], z_m, np.nan).astype(np.float32)


def with_background(depth_m: Float32, box: ObjectBox, generator: np.random.Generator) -> Float32:
    """An object's depth map (rows, columns) with a random post or panel where it has no surface."""
    behind = post(depth_m, generator) if generator.random() < 0.5 else panel(depth_m, box, generator)
    return np.where(np.isnan(depth_m), behind, depth_m)
