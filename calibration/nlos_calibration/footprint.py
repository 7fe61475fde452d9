"""Where the lidar's view meets the wall: its corners, the cells of the map, and how many of them are on the wall."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Extent

MAP_SHAPE = 64, 80
"""Rows and columns of the map that a frame is reduced to."""


@dataclass(frozen=True)
class Footprint:
    """Points of the wall plane in the wall frame's x and y; NaN where a beam never meets it."""

    corners_m: Float64
    """(4, 2); of the view: upper left, upper right, lower right, lower left."""
    cells_m: Float64
    """(rows, columns, 2); where the beam through each cell's centre meets the plane. cells_m[i] is row i's line."""
    on_wall: NDArray[np.bool_]
    """(rows, columns); the cells that meet the plane within the wall's extent."""

    @property
    def share(self) -> float:
        """Of the cells that are on the wall."""
        return float(self.on_wall.mean())


def footprint(
    wall_from_lidar: Float64, intrinsics: Intrinsics, wall: Extent, shape: tuple[int, int] = MAP_SHAPE
) -> Footprint:
    """The footprint of a map of `shape` cells seen from the pose (4, 4)."""
    cells_m = on_plane(wall_from_lidar, intrinsics.scaled(shape[1], shape[0]).rays())
    edges = intrinsics.scaled(1, 1)
    x, y = (np.array([-0.5, 0.5]) - edges.ppx) / edges.fx, (np.array([-0.5, 0.5]) - edges.ppy) / edges.fy
    corners = np.array([[x[0], y[0], 1.0], [x[1], y[0], 1.0], [x[1], y[1], 1.0], [x[0], y[1], 1.0]])
    across, up = cells_m[..., 0], cells_m[..., 1]
    on_wall = (across >= wall.x_min_m) & (across <= wall.x_max_m) & (up >= wall.y_min_m) & (up <= wall.y_max_m)
    return Footprint(on_plane(wall_from_lidar, corners), cells_m, on_wall)


def on_plane(wall_from_lidar: Float64, rays: Float64) -> Float64:
    """Wall x and y (..., 2) of where rays (..., 3) in the lidar frame meet the wall plane; NaN where they never do."""
    directions = rays @ wall_from_lidar[:3, :3].T
    origin = wall_from_lidar[:3, 3]
    towards = np.where(directions[..., 2] < 0.0, -directions[..., 2], np.nan)
    return origin[:2] + directions[..., :2] * (origin[2] / towards)[..., np.newaxis]
