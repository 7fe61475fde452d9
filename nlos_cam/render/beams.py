"""The first leg: where each beam of the lidar lands, and what returns straight from there (S1)."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import DeviceConstants, Rig
from numpy.typing import NDArray

from nlos_cam.render.near import NEAR_DIAGONALS, softened, solid_angle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
SPEED_OF_LIGHT_M_PER_S = 299_792_458.0


@dataclass(frozen=True)
class Beams:
    """Beams in the order of the image, flattened; lengths are NaN where a beam meets nothing."""

    shape: tuple[int, int]
    foot_m: Array
    """(n, 3); where the beam lands, in the wall frame."""
    direction: Array
    """(n, 3); unit, in the wall frame."""
    length_m: Array
    """(n,); d1."""
    cos_incidence: Array
    """(n,); to the normal of what it meets."""
    cos_axis: Array
    """(n,); beam to optical axis: S5 turns range into depth by it."""
    on_wall: Mask
    """(n,); the beam lights the wall, and so may reach the hidden object."""
    direct: Array
    """(n,); I_direct, 0 where nothing returns inside the gate."""
    lidar_m: Array
    """(3,)."""

    def met(
        self, rig: Rig, which: NDArray[np.int64], length_m: Array, cosine: Array, albedo: Array, solid_angle: float
    ) -> "Beams":
        """The same where some beams meet something on their way, at a length and a cosine (k,), and return from it."""
        foot, length, incidence = self.foot_m.copy(), self.length_m.copy(), self.cos_incidence.copy()
        on_wall, direct = self.on_wall.copy(), self.direct.copy()
        foot[which] = self.lidar_m + length_m[:, None] * self.direction[which]
        length[which], incidence[which], on_wall[which] = length_m, cosine, False
        direct[which] = albedo * returned(rig, length_m, cosine, solid_angle)
        return replace(self, foot_m=foot, length_m=length, cos_incidence=incidence, on_wall=on_wall, direct=direct)

    def of_rows(self, start: int, end: int) -> "Beams":
        """Those of some rows of the image."""
        kept, columns = slice(start * self.shape[1], end * self.shape[1]), vars(self)
        parts = {name: columns[name][kept] for name in columns if name not in {"shape", "lidar_m"}}
        return Beams(shape=(end - start, self.shape[1]), lidar_m=self.lidar_m, **parts)

    def without_direct(self) -> "Beams":
        """The same where nothing returns straight."""
        return replace(self, direct=np.zeros_like(self.direct))


def cast(rig: Rig, intrinsics: Intrinsics, *, lambertian: bool = False, occluder: bool = True) -> Beams:
    """One beam per pixel of the intrinsics: on to the occluder if that is nearer, else the wall, else nothing.

    A rig's beams are worked out once, and cannot be written into.
    """
    return _cast(rig, intrinsics, lambertian, occluder)  # pyright: ignore[reportArgumentType]  frozen, so hashable


@lru_cache(maxsize=16)
def _cast(rig: Rig, intrinsics: Intrinsics, lambertian: bool, occluder: bool) -> Beams:
    pose = rig.wall_from_lidar
    lidar = pose[:3, 3]
    rays = intrinsics.rays().reshape(-1, 3)
    cos_axis = 1 / np.linalg.norm(rays, axis=-1)
    direction = (rays @ pose[:3, :3].T) * cos_axis[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall_length = np.where(direction[:, 2] < 0, -lidar[2] / direction[:, 2], np.inf)
        wall_point = lidar + wall_length[:, None] * direction
        wall_length[~_inside(rig, wall_point)] = np.inf
        stop_length = _occluder_length(rig, lidar, direction) if occluder else np.full_like(wall_length, np.inf)
    on_wall = wall_length < stop_length
    length = np.minimum(wall_length, stop_length)
    length[np.isinf(length)] = np.nan
    cosine = np.where(on_wall, -direction[:, 2], np.abs(direction[:, 0]))
    direct = returned(rig, length, cosine, solid_angle(lambertian=lambertian))
    foot = lidar + length[:, None] * direction
    shape = (intrinsics.height, intrinsics.width)
    beams = Beams(shape, foot, direction, length, cosine, cos_axis, on_wall, direct, lidar)
    for column in (foot, direction, length, cosine, cos_axis, on_wall, direct, lidar):
        column.flags.writeable = False
    return beams


def returned(rig: Rig, length_m: Array, cosine: Array, solid_angle: float) -> Array:
    """I_direct (n,) of S1, with S_unit_wall the device's receiver cell; 0 outside the gate or where nothing is met."""
    cell_m2 = rig.device.receiver_cell_m2
    near_m = NEAR_DIAGONALS * np.sqrt(2 * cell_m2)
    in_gate = 2 * length_m < SPEED_OF_LIGHT_M_PER_S * rig.device.gate_s
    light = cosine * cell_m2 / (solid_angle * softened(length_m**2, cell_m2 / solid_angle, near_m))
    return np.where(in_gate, light, 0.0)


def gate_bins(device: DeviceConstants) -> int:
    """Bins of path length that begin inside the gate: the last may reach beyond it."""
    return max(int(np.ceil(SPEED_OF_LIGHT_M_PER_S * device.gate_s / device.bin_m)), 1)


def _inside(rig: Rig, point: Array) -> Mask:
    x, y, wall = point[:, 0], point[:, 1], rig.wall
    return (x >= wall.x_min_m) & (x <= wall.x_max_m) & (y >= wall.y_min_m) & (y <= wall.y_max_m)


def _occluder_length(rig: Rig, lidar: Array, direction: Array) -> Array:
    """How far along each beam the occluder's half plane stands; inf where the beam misses it."""
    if rig.occluder is None:
        return np.full(len(direction), np.inf)
    length = (rig.occluder.x_m - lidar[0]) / direction[:, 0]
    height = lidar[2] + length * direction[:, 2]
    return np.where((length > 0) & (height >= rig.occluder.z_min_m), length, np.inf)
