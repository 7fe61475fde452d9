"""Geometry of the first and last leg: laser spots and direct returns (S1), near contact, cells of
the relay wall.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
from nlos_calibration import DeviceConstants, Intrinsics, Rig
from nlos_calibration.arrays import Float64, Mask
from numpy.typing import NDArray

from nlos_cam.frames import inner

NEAR_DIAGONALS = 4
"""Near contact begins at this many diagonals of the larger cell."""
NEIGHBOR_GAIN = 1.2
"""Factor on the near-contact term, as neighbors receive too: at 1 a plane of square cells receives
7 % more than was sent. Sufficient for cells up to twice as long as wide.
"""
GOLDEN = (5**0.5 - 1) / 2
Area = TypeVar("Area", Float64, float)


def solid_angle(*, lambertian: bool) -> float:
    """Return the solid angle over which a bounce spreads light: pi with the rendering equation's
    cosine, else 2 pi.
    """
    return np.pi if lambertian else 2 * np.pi


def contact_m2(area_m2: Area, solid_angle: float) -> Area:
    """Return the near-contact term added to d^2 at a cell: with it, a plane of cells receives no
    more than was sent.
    """
    return NEIGHBOR_GAIN * area_m2 / solid_angle


def softened(squared_m2: Any, soft_m2: Any, near_m: Any) -> Any:
    """Return d^2 limited at contact: plus the receiving area over the solid angle, fading out
    towards `near_m`.

    1 / d^2 from the middle of a cell is the average over the cell only from afar. On the axis of a
    disc of area a the average of 1 / d^2 is 1 / (d^2 + a / pi), so the disc never receives more
    than was sent. Beyond a few diagonals the two agree, and S1 and S2 hold exactly. For arrays;
    compiled loops call `softened_leg`.
    """
    # The squared ramp goes to 0 with slope 0 at near_m: no step in light or in its derivative
    # there.
    ramp = np.maximum(1 - squared_m2 / (near_m * near_m), 0.0)
    return squared_m2 + soft_m2 * ramp * ramp


softened_leg: Any = inner(error_model="numpy")(softened)


SPEED_OF_LIGHT_M_PER_S = 299_792_458.0


@dataclass(frozen=True)
class Beams:
    """Beams in the order of the image, flattened; lengths are NaN for beams that meet nothing."""

    shape: tuple[int, int]
    laser_spot_m: Float64
    """(n, 3); point where the beam lands, in the wall frame."""
    direction: Float64
    """(n, 3); unit, in the wall frame."""
    length_m: Float64
    """(n,); d1."""
    cos_incidence: Float64
    """(n,); to the normal of the surface it meets."""
    cos_axis: Float64
    """(n,); beam to optical axis: S5 converts range to depth with it."""
    on_wall: Mask
    """(n,); True for beams that light the wall and so may reach the hidden object."""
    direct: Float64
    """(n,); I_direct, 0 if nothing returns inside the gate."""
    lidar_m: Float64
    """(3,)."""

    def with_hits(
        self,
        rig: Rig,
        which: NDArray[np.int64],
        length_m: Float64,
        cosine: Float64,
        albedo: Float64,
        solid_angle: float,
    ) -> "Beams":
        """Return the beams with some stopped on their way, at a length and a cosine (k,), and
        returning from there.
        """
        foot = self.laser_spot_m.copy()
        length = self.length_m.copy()
        incidence = self.cos_incidence.copy()
        on_wall = self.on_wall.copy()
        direct = self.direct.copy()
        foot[which] = self.lidar_m + length_m[:, None] * self.direction[which]
        length[which] = length_m
        incidence[which] = cosine
        on_wall[which] = False
        direct[which] = albedo * returned(rig, length_m, cosine, solid_angle)
        return replace(
            self,
            laser_spot_m=foot,
            length_m=length,
            cos_incidence=incidence,
            on_wall=on_wall,
            direct=direct,
        )

    @cached_property
    def lit(self) -> tuple[Float64, Float64, Float64]:
        """Laser spots (k, 3), d1 (k,) and cos t1 (k,) of the beams that light the wall."""
        return (
            self.laser_spot_m[self.on_wall],
            self.length_m[self.on_wall],
            self.cos_incidence[self.on_wall],
        )

    @cached_property
    def outermost(self) -> tuple[Float64, Float64]:
        """Laser spots (k, 3) and d1 (k,) of the lit beams at the ends of each row and column of the
        image.
        """
        # Beams that miss the wall count as beyond both ends, so that they are never an extreme.
        number = np.arange(len(self.on_wall)).reshape(self.shape)
        lit = self.on_wall.reshape(self.shape)
        ends = [np.where(lit, number, empty) for empty in (len(self.on_wall), -1)]
        chosen = np.concatenate([ends[0].min(0), ends[0].min(1), ends[1].max(0), ends[1].max(1)])
        chosen = np.unique(chosen[(chosen >= 0) & (chosen < len(self.on_wall))])
        return self.laser_spot_m[chosen], self.length_m[chosen]

    def rows(self, start: int, end: int) -> "Beams":
        """Return the beams of the rows [start, end) of the image."""
        kept = slice(start * self.shape[1], end * self.shape[1])
        parts = {one.name: getattr(self, one.name) for one in fields(self)}
        parts = {
            name: column[kept] for name, column in parts.items() if name not in {"shape", "lidar_m"}
        }
        return Beams(shape=(end - start, self.shape[1]), lidar_m=self.lidar_m, **parts)

    def without_direct(self) -> "Beams":
        """Return the beams without direct returns."""
        return replace(self, direct=np.zeros_like(self.direct))


def cast(
    rig: Rig, intrinsics: Intrinsics, *, lambertian: bool = False, occluder: bool = True
) -> Beams:
    """Return one beam per pixel of the intrinsics, up to the occluder or the wall, whichever is
    nearer.

    Cached per rig; the arrays are read-only.
    """
    # The records are frozen, so they can be hashed.
    return _cast(rig, intrinsics, lambertian, occluder)  # pyright: ignore[reportArgumentType]


@lru_cache(maxsize=16)
def _cast(rig: Rig, intrinsics: Intrinsics, lambertian: bool, occluder: bool) -> Beams:
    pose = rig.wall_from_lidar
    lidar = pose[:3, 3]
    rays = intrinsics.rays().reshape(-1, 3)
    # Rays have z = 1 in the lidar's frame, so the cosine to the optical axis is 1 / |ray|.
    cos_axis = 1 / np.linalg.norm(rays, axis=-1)
    direction = (rays @ pose[:3, :3].T) * cos_axis[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        # The wall is the plane z = 0: lidar_z + t direction_z = 0, ahead of the lidar only for rays
        # towards the wall.
        wall_length = np.where(direction[:, 2] < 0, -lidar[2] / direction[:, 2], np.inf)
        wall_point = lidar + wall_length[:, None] * direction
        wall_length[~rig.wall.contains(wall_point)] = np.inf
        stop_length = (
            _occluder_length(rig, lidar, direction)
            if occluder
            else np.full_like(wall_length, np.inf)
        )
    on_wall = wall_length < stop_length
    length = np.minimum(wall_length, stop_length)
    length[np.isinf(length)] = np.nan
    # The wall's normal is +z and the occluder's is x: the cosine is that component of the unit
    # direction.
    cosine = np.where(on_wall, -direction[:, 2], np.abs(direction[:, 0]))
    direct = returned(rig, length, cosine, solid_angle(lambertian=lambertian))
    foot = lidar + length[:, None] * direction
    shape = (intrinsics.height, intrinsics.width)
    beams = Beams(shape, foot, direction, length, cosine, cos_axis, on_wall, direct, lidar)
    for column in (foot, direction, length, cosine, cos_axis, on_wall, direct, lidar):
        column.flags.writeable = False
    return beams


def returned(rig: Rig, length_m: Float64, cosine: Float64, solid_angle: float) -> Float64:
    """Return I_direct (n,) of S1, with the device's receiver cell as S_unit_wall; 0 outside the
    gate or for no hit.
    """
    cell_m2 = rig.device.receiver_cell_m2
    near_m = NEAR_DIAGONALS * np.sqrt(2 * cell_m2)
    in_gate = 2 * length_m < SPEED_OF_LIGHT_M_PER_S * rig.device.gate_s
    # S1: cos t1 S / (solid angle d^2), where d^2 is limited at contact. The cell S is the
    # receiver's, not the grid's.
    light = cosine * cell_m2 / (solid_angle * softened(length_m**2, cell_m2 / solid_angle, near_m))
    return np.where(in_gate, light, 0.0)


def gate_bins(device: DeviceConstants) -> int:
    """Return the number of path-length bins that begin inside the gate; the last may reach beyond
    it.
    """
    return max(int(np.ceil(SPEED_OF_LIGHT_M_PER_S * device.gate_s / device.bin_m)), 1)


def _occluder_length(rig: Rig, lidar: Float64, direction: Float64) -> Float64:
    """Return the distance along each beam to the occluder's half plane; inf for beams that miss
    it.
    """
    # A ray along the half plane divides by 0: inf or NaN, neither of which compares as a hit.
    if rig.occluder is None:
        return np.full(len(direction), np.inf)
    # The half plane is x = x_m: lidar_x + t direction_x = x_m, and it stops the beam if it is high
    # enough there.
    length = (rig.occluder.x_m - lidar[0]) / direction[:, 0]
    height = lidar[2] + length * direction[:, 2]
    return np.where((length > 0) & (height >= rig.occluder.z_min_m), length, np.inf)


NO_OCCLUDER = (np.inf, np.inf)
"""Edge that blocks nothing: no x lies on both sides of it."""


@dataclass(frozen=True)
class Relay:
    """Grid of cells on the relay wall, with the leg from each back to the lidar."""

    x_m: Float64
    """(n,)."""
    y_m: Float64
    """(n,)."""
    length_m: Float64
    """(n,); d4."""
    cos_lidar: Float64
    """(n,); direction to the lidar against the wall's normal."""
    cell_m2: float
    diagonal_m: float
    """Of a cell."""

    def select(self, which: Mask) -> "Relay":
        """Return the cells with True in a mask (n,)."""
        columns = self.x_m[which], self.y_m[which], self.length_m[which], self.cos_lidar[which]
        return Relay(*columns, self.cell_m2, self.diagonal_m)

    def behind(self, edge_m: tuple[float, float], lidar_m: Float64) -> Mask:
        """Return a mask (n,) of the cells that an occluder with that edge hides from the lidar."""
        return behind(edge_m, self.x_m, np.zeros_like(self.x_m), lidar_m)


def spread(count: int, sample: int) -> NDArray[np.int64]:
    """Return the indices of about `sample` of `count` points of a grid in the order of its rows,
    spread over rows and columns; all where there are no more.
    """
    if count <= sample:
        return np.arange(count)
    # One of each of `sample` equal runs, at a place that goes by the golden ratio: every so many
    # points alone could all lie in one column of the grid.
    run = np.arange(sample)
    # of runs of one or two points, two neighbors may give the same
    return np.unique(((run + run * GOLDEN % 1) * count / sample).astype(np.int64))


def occluder_edge(rig: Rig) -> tuple[float, float]:
    """Return (x_m, z_min_m) of the occluder, or an edge that blocks nothing."""
    return (rig.occluder.x_m, rig.occluder.z_min_m) if rig.occluder else NO_OCCLUDER


def relay_cells(rig: Rig, lidar_m: Float64, columns: int, rows: int) -> Relay:
    """Return the relay wall as columns x rows cells, as if nothing stood in front of it."""
    # S2 integrates over the relay wall: cells of equal area, each at its center.
    extent = rig.relay
    pitch_x = (extent.x_max_m - extent.x_min_m) / columns
    pitch_y = (extent.y_max_m - extent.y_min_m) / rows
    x, y = np.meshgrid(
        extent.x_min_m + (np.arange(columns) + 0.5) * pitch_x,
        extent.y_min_m + (np.arange(rows) + 0.5) * pitch_y,
    )
    x = x.ravel().astype(np.float64)
    y = y.ravel().astype(np.float64)
    length = np.sqrt((x - lidar_m[0]) ** 2 + (y - lidar_m[1]) ** 2 + lidar_m[2] ** 2)
    return Relay(
        x, y, length, lidar_m[2] / length, pitch_x * pitch_y, float(np.hypot(pitch_x, pitch_y))
    )


def behind(edge_m: tuple[float, float], x_m: Float64, z_m: Float64, lidar_m: Float64) -> Mask:
    """Return a mask (n,) of the points that the half plane x = edge_m[0], z >= edge_m[1] hides from
    the lidar.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        # Share of the way from lidar to point at which the line crosses x = edge_m[0]; it is cut
        # there if it is high enough.
        share = (edge_m[0] - lidar_m[0]) / (x_m - lidar_m[0])
        height = lidar_m[2] + share * (z_m - lidar_m[2])
        return (share > 0) & (share < 1) & (height >= edge_m[1])
