"""The first leg: where each beam of the lidar lands, and what returns straight from there (S1)."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

Array = NDArray[np.float64]
SPEED_OF_LIGHT_M_PER_S = 299_792_458.0


@dataclass(frozen=True)
class Beams:
    """Beams in the order of the image, flattened; lengths are NaN where a beam meets nothing."""

    shape: tuple[int, int]
    foot_m: Array
    """(n, 3); where the beam lands, in the wall frame."""
    length_m: Array
    """(n,); d1."""
    cos_incidence: Array
    """(n,); to the normal of what it meets."""
    cos_axis: Array
    """(n,); beam to optical axis: S5 turns range into depth by it."""
    on_wall: NDArray[np.bool_]
    """(n,); the beam lights the wall, and so may reach the hidden object."""
    direct: Array
    """(n,); I_direct, 0 where nothing returns inside the gate."""
    lidar_m: Array
    """(3,)."""


def cast(rig: Rig, intrinsics: Intrinsics) -> Beams:
    """One beam per pixel of the intrinsics: on to the occluder if that is nearer, else the wall, else nothing."""
    pose = rig.wall_from_lidar
    lidar = pose[:3, 3]
    rays = intrinsics.rays().reshape(-1, 3)
    cos_axis = 1 / np.linalg.norm(rays, axis=-1)
    direction = (rays @ pose[:3, :3].T) * cos_axis[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall_length = np.where(direction[:, 2] < 0, -lidar[2] / direction[:, 2], np.inf)
        wall_point = lidar + wall_length[:, None] * direction
        wall_length[~_inside(rig, wall_point)] = np.inf
        stop_length = _occluder_length(rig, lidar, direction)
    on_wall = wall_length < stop_length
    length = np.minimum(wall_length, stop_length)
    length[np.isinf(length)] = np.nan
    cos_incidence = np.where(on_wall, -direction[:, 2], np.abs(direction[:, 0]))
    in_gate = 2 * length < SPEED_OF_LIGHT_M_PER_S * rig.device.gate_s
    # S1, with S_unit_wall the device's receiver cell
    returned = cos_incidence * rig.device.receiver_cell_m2 / (2 * np.pi * length**2)
    foot = lidar + length[:, None] * direction
    shape = (intrinsics.height, intrinsics.width)
    return Beams(shape, foot, length, cos_incidence, cos_axis, on_wall, np.where(in_gate, returned, 0.0), lidar)


def _inside(rig: Rig, point: Array) -> NDArray[np.bool_]:
    x, y, wall = point[:, 0], point[:, 1], rig.wall
    return (x >= wall.x_min_m) & (x <= wall.x_max_m) & (y >= wall.y_min_m) & (y <= wall.y_max_m)


def _occluder_length(rig: Rig, lidar: Array, direction: Array) -> Array:
    """How far along each beam the occluder's half plane stands; inf where the beam misses it."""
    if rig.occluder is None:
        return np.full(len(direction), np.inf)
    length = (rig.occluder.x_m - lidar[0]) / direction[:, 0]
    height = lidar[2] + length * direction[:, 2]
    return np.where((length > 0) & (height >= rig.occluder.z_min_m), length, np.inf)
