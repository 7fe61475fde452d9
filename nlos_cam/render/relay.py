"""The third bounce: the relay wall as a grid of cells, and the leg from each back to the lidar."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

Array = NDArray[np.float64]
NO_OCCLUDER = (np.inf, np.inf)
"""An edge that blocks nothing: no x lies on both sides of it."""


@dataclass(frozen=True)
class Relay:
    """The cells of the relay wall that the lidar sees (the occluder cuts off the others)."""

    x_m: Array
    """(n,)."""
    y_m: Array
    """(n,)."""
    length_m: Array
    """(n,); d4."""
    cell_m2: float


def occluder_edge(rig: Rig) -> tuple[float, float]:
    """(x_m, z_min_m) of the occluder, or an edge that blocks nothing."""
    return (rig.occluder.x_m, rig.occluder.z_min_m) if rig.occluder else NO_OCCLUDER


def relay_cells(rig: Rig, lidar_m: Array, columns: int, rows: int) -> Relay:
    """Cut the relay wall into columns x rows cells and keep those in the lidar's sight."""
    extent = rig.relay
    pitch_x, pitch_y = (extent.x_max_m - extent.x_min_m) / columns, (extent.y_max_m - extent.y_min_m) / rows
    x, y = np.meshgrid(
        extent.x_min_m + (np.arange(columns) + 0.5) * pitch_x,
        extent.y_min_m + (np.arange(rows) + 0.5) * pitch_y,
    )
    x, y = x.ravel().astype(np.float64), y.ravel().astype(np.float64)
    edge_x, edge_z = occluder_edge(rig)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (edge_x - x) / (lidar_m[0] - x)
        behind = (share > 0) & (share < 1) & (share * lidar_m[2] >= edge_z)
    seen = ~behind
    length = np.sqrt((x - lidar_m[0]) ** 2 + (y - lidar_m[1]) ** 2 + lidar_m[2] ** 2)
    return Relay(x[seen], y[seen], length[seen], pitch_x * pitch_y)
