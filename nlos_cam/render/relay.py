"""The third bounce: the relay wall as a grid of cells, and the leg from each back to the lidar."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
NO_OCCLUDER = (np.inf, np.inf)
"""An edge that blocks nothing: no x lies on both sides of it."""


@dataclass(frozen=True)
class Relay:
    """Cells of the relay wall."""

    x_m: Array
    """(n,)."""
    y_m: Array
    """(n,)."""
    length_m: Array
    """(n,); d4."""
    cos_lidar: Array
    """(n,); the way to the lidar against the wall's normal."""
    cell_m2: float
    diagonal_m: float
    """Of a cell."""

    def kept(self, which: Mask) -> "Relay":
        """Only some of the cells."""
        columns = self.x_m[which], self.y_m[which], self.length_m[which], self.cos_lidar[which]
        return Relay(*columns, self.cell_m2, self.diagonal_m)

    def behind(self, edge_m: tuple[float, float], lidar_m: Array) -> Mask:
        """Which cells (n,) an occluder of that edge hides from the lidar."""
        return behind(edge_m, self.x_m, np.zeros_like(self.x_m), lidar_m)


def occluder_edge(rig: Rig) -> tuple[float, float]:
    """(x_m, z_min_m) of the occluder, or an edge that blocks nothing."""
    return (rig.occluder.x_m, rig.occluder.z_min_m) if rig.occluder else NO_OCCLUDER


def relay_cells(rig: Rig, lidar_m: Array, columns: int, rows: int) -> Relay:
    """Cut the relay wall into columns x rows cells, as if nothing stood in front of it."""
    extent = rig.relay
    pitch_x, pitch_y = (extent.x_max_m - extent.x_min_m) / columns, (extent.y_max_m - extent.y_min_m) / rows
    x, y = np.meshgrid(
        extent.x_min_m + (np.arange(columns) + 0.5) * pitch_x,
        extent.y_min_m + (np.arange(rows) + 0.5) * pitch_y,
    )
    x, y = x.ravel().astype(np.float64), y.ravel().astype(np.float64)
    length = np.sqrt((x - lidar_m[0]) ** 2 + (y - lidar_m[1]) ** 2 + lidar_m[2] ** 2)
    return Relay(x, y, length, lidar_m[2] / length, pitch_x * pitch_y, float(np.hypot(pitch_x, pitch_y)))


def behind(edge_m: tuple[float, float], x_m: Array, z_m: Array, lidar_m: Array) -> Mask:
    """Which points (n,) the half plane x = edge_m[0], z >= edge_m[1] hides from the lidar."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (edge_m[0] - lidar_m[0]) / (x_m - lidar_m[0])
        height = lidar_m[2] + share * (z_m - lidar_m[2])
        return (share > 0) & (share < 1) & (height >= edge_m[1])
