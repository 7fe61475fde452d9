"""A bench with its occluder as a lidar's depth map: rays cast on a wall and a sheet, and what else may stand there."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float64
from wall_scenes import View

WALL_EXTENT_M = 2.0


@dataclass(frozen=True)
class Sheet:
    """A flat occluder: the paper's, and how it may be set up badly."""

    x_m: float = 0.2
    """Of the edge at y = 0."""
    gap_m: float = 0.1
    lean_deg: float = 0.0
    """About y; positive leans away from the lidar's foot."""
    twist_deg: float = 0.0
    """About z; positive where x grows with y."""
    edge_deg: float = 0.0
    """Positive where the gap grows with y."""
    height_m: float = np.inf
    bottom_m: float = -np.inf
    top_m: float = np.inf
    """The y that it ends at."""


def bench(seen: View, sheet: Sheet | None, *, beams: int = 1) -> Float64:
    """Depth (height, width) of wall and sheet, inf where a ray meets neither.

    With more than one beam across a pixel it reads their mean: one on the edge flies between sheet and wall.
    """
    pinhole = seen.pinhole.scaled(seen.pinhole.width * beams, seen.pinhole.height)
    rays = pinhole.rays() @ seen.pose[:3, :3].T
    lidar = seen.pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall_m = np.where(rays[..., 2] < 0.0, -lidar[2] / rays[..., 2], np.inf)
        wall_m[wall_m * rays[..., 0] > WALL_EXTENT_M] = np.inf
        depth_m = wall_m if sheet is None else np.minimum(wall_m, _sheet_depth(sheet, lidar, rays))
    return depth_m.reshape(pinhole.height, seen.pinhole.width, beams).mean(axis=-1)


def _sheet_depth(sheet: Sheet, lidar: Float64, rays: Float64) -> Float64:
    """Along each ray, as far as it meets the sheet: normal . (p - edge) = 0."""
    lean, twist = np.tan(np.radians([sheet.lean_deg, sheet.twist_deg]))
    normal, edge = np.array([1.0, -twist, -lean]), np.array([sheet.x_m, 0.0, sheet.gap_m])
    depth_m = (normal @ (edge - lidar)) / (rays @ normal)
    y, z = (lidar[axis] + depth_m * rays[..., axis] for axis in (1, 2))
    above_m = z - sheet.gap_m - np.tan(np.radians(sheet.edge_deg)) * y
    on = (above_m >= 0.0) & (above_m <= sheet.height_m) & (y >= sheet.bottom_m) & (y <= sheet.top_m)
    return np.where((depth_m > 0.0) & on, depth_m, np.inf)


def ball(seen: View, centre_m: tuple[float, float, float], radius_m: float) -> Float64:
    """Depth (height, width) of a ball in the wall frame, inf beside it."""
    rays = seen.pinhole.rays() @ seen.pose[:3, :3].T
    towards = np.asarray(centre_m) - seen.pose[:3, 3]
    square, along = (rays**2).sum(axis=-1), rays @ towards
    inside = along**2 - square * (towards @ towards - radius_m**2)
    return np.where((inside > 0.0) & (along > 0.0), (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)
