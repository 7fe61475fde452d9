"""Legs between patches and points of the wall, many at a time (numba, float32): weight, length, visibility.

These are compiled into `kernels`, whose cache looks at its own file alone: after a change here, delete __pycache__.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.render.visibility import HeightField, blocked

Int32 = NDArray[np.int32]

FAST = {"contract", "reassoc", "nsz", "arcp"}


class Surface32(NamedTuple):
    """Patches as columns of float32."""

    x_m: Float32
    y_m: Float32
    z_m: Float32
    normal_x: Float32
    normal_y: Float32
    normal_z: Float32
    soft_m2: Float32
    """What near contact adds to d^2: the area over the solid angle that the radiometry scatters into."""
    row: NDArray[np.int64]
    column: NDArray[np.int64]


class Points32(NamedTuple):
    """Points of the wall: the feet of beams, or relay cells; with the rest of their way to the lidar."""

    x_m: Float32
    y_m: Float32
    length_m: Float32
    weight: Float32
    soft_m2: np.float32


class Optics(NamedTuple):
    """What all legs share."""

    edge_x_m: np.float32
    edge_z_m: np.float32
    near_m2: np.float32
    """Square of the distance at which near contact begins."""
    lambertian: bool
    inverse_bin: np.float32
    """Sub-bins per metre."""
    sectors: int
    """Of each face of the horizon tables; 0 where nothing shades."""


class Legs(NamedTuple):
    """Scratch for the legs from one patch to many points of the wall."""

    weight: Float32
    length_m: Float32
    sector: Int32
    major: Float32


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def geometry(
    legs: Legs,
    s: int,
    surface: Surface32,
    points: Points32,
    start: int,
    count: int,
    optics: Optics,
    field: HeightField,
    outgoing: bool,
) -> None:
    """Legs from patch s to points: weight without visibility and length, vector by vector.

    Towards the lidar (`outgoing`) the weight has the wall's cosine, and in Lambertian radiometry the patch's; from it
    the patch's, and in Lambertian radiometry the wall's.
    """
    x, y, z = surface.x_m[s], surface.y_m[s], surface.z_m[s]
    nx, ny, nz = surface.normal_x[s], surface.normal_y[s], surface.normal_z[s]
    soft = points.soft_m2 if outgoing else surface.soft_m2[s]
    to_edge, nothing, one, two = optics.edge_x_m - x, np.float32(0), np.float32(1), np.float32(2)
    inverse_x, inverse_y = np.float32(1 / field.pitch_x_m), np.float32(-1 / field.pitch_y_m)
    half, last, faces = np.float32(optics.sectors / 2), np.float32(optics.sectors - 1), np.float32(optics.sectors)
    at_x, at_y, light = (
        points.x_m[start : start + count],
        points.y_m[start : start + count],
        points.weight[start : start + count],
    )
    for i in range(count):
        dx, dy = at_x[i] - x, at_y[i] - y
        squared = dx * dx + dy * dy + z * z
        length = np.sqrt(squared)
        facing = nx * dx + ny * dy - nz * z
        cut = (to_edge * (optics.edge_x_m - at_x[i]) < nothing) & (z * (one - to_edge / dx) >= optics.edge_z_m)
        ramp = max(one - squared / optics.near_m2, nothing)
        cosine = z if outgoing else facing
        if optics.lambertian:
            cosine = z * facing / length
        weight = light[i] * cosine / (length * (squared + soft * ramp * ramp))
        legs.weight[i] = weight if (facing > nothing) & (not cut) else nothing
        legs.length_m[i] = length
        u, v = dx * inverse_x, dy * inverse_y
        along_columns = abs(u) >= abs(v)
        major, minor = (u if along_columns else v), (v if along_columns else u)
        legs.major[i] = abs(major)
        inside = min((minor / max(abs(major), np.float32(1e-20)) + one) * half, last)
        face = (nothing if along_columns else two) + (nothing if major >= nothing else one)
        legs.sector[i] = np.int32(face * faces + np.floor(inside))


@numba.njit(cache=True)
def shade(
    legs: Legs,
    s: int,
    surface: Surface32,
    points: Points32,
    start: int,
    count: int,
    field: HeightField,
    low: Float32,
    high: Float32,
) -> None:
    """Set the weight of legs that the object blocks to 0."""
    z = surface.z_m[s]
    for i in range(count):
        if z >= legs.major[i] * high[s, legs.sector[i]]:
            continue
        if z >= legs.major[i] * low[s, legs.sector[i]]:
            u = (points.x_m[start + i] - surface.x_m[s]) / field.pitch_x_m
            v = (surface.y_m[s] - points.y_m[start + i]) / field.pitch_y_m
            if legs.weight[i] == 0 or not blocked(field, surface.row[s], surface.column[s], z, u, v):
                continue
        legs.weight[i] = 0


@numba.njit(cache=True, inline="always")
def scratch(count: int) -> Legs:
    return Legs(
        np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.int32), np.empty(count, np.float32)
    )
