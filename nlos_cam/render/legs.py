"""Legs between patches and points of the wall, compiled in float32: weight, length, and what the object blocks.

One patch at a time with many points side by side, so that all but the walks of `shade` are vector operations.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Int32, Mask
from numpy.typing import NDArray

from nlos_cam.render.visibility import HeightField, blocked

FAST = {"contract", "reassoc", "nsz", "arcp"}


class NumbaSurface(NamedTuple):
    """Patches as columns of float32."""

    x_m: Float32
    y_m: Float32
    z_m: Float32
    normal_x: Float32
    normal_y: Float32
    normal_z: Float32
    soft_m2: Float32
    """Near-contact term added to d^2."""
    strength: Float32
    """Albedo times true area."""
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    low: Float32
    """(n, FACES * sectors); bounds of the horizons, empty if nothing shades."""
    high: Float32
    walk: NDArray[np.uint8]
    """(n, FACES * sectors, 2); first and last step of a walk between the bounds."""
    shaded: Mask
    """(n,); True if some leg may be blocked."""


class NumbaPoints(NamedTuple):
    """Points of the wall, laser spots or relay cells, with the leg from each to the lidar."""

    x_m: Float32
    y_m: Float32
    length_m: Float32
    weight: Float32
    soft_m2: np.float32


class NumbaOptics(NamedTuple):
    """Constants shared by all legs."""

    edge_x_m: np.float32
    edge_z_m: np.float32
    near_m2: np.float32
    """Square of the distance at which near contact begins."""
    lambertian: bool
    inverse_bin: np.float32
    """Sub-bins per meter."""
    sectors: int
    """Sectors per face of the horizon tables; 0 if nothing shades."""


class NumbaLegs(NamedTuple):
    """Scratch memory for the legs from one patch to many points of the wall."""

    weight: Float32
    length_m: Float32
    sector: Int32
    major: Float32
    todo: Int32
    """Legs to look at again."""


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def geometry(
    legs: NumbaLegs,
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    start: int,
    count: int,
    optics: NumbaOptics,
    field: HeightField,
    outgoing: bool,
) -> None:
    """Fill in the legs from patch s to points: weight without visibility, and length, vector by vector.

    Towards the lidar (`outgoing`) the weight has the wall's cosine, from it the patch's; in Lambertian radiometry both.
    """
    x, y, z = surface.x_m[s], surface.y_m[s], surface.z_m[s]
    nx, ny, nz = surface.normal_x[s], surface.normal_y[s], surface.normal_z[s]
    soft = points.soft_m2 if outgoing else surface.soft_m2[s]
    to_edge, nothing, one, two = optics.edge_x_m - x, np.float32(0), np.float32(1), np.float32(2)
    inverse_x, inverse_y = np.float32(1 / field.pitch_x_m), np.float32(-1 / field.pitch_y_m)
    half, last, faces = np.float32(optics.sectors / 2), np.float32(optics.sectors - 1), np.float32(optics.sectors)
    end = start + count
    at_x, at_y, light = points.x_m[start:end], points.y_m[start:end], points.weight[start:end]
    for i in range(count):
        dx, dy = at_x[i] - x, at_y[i] - y
        squared = dx * dx + dy * dy + z * z
        length = np.sqrt(squared)
        facing = nx * dx + ny * dy - nz * z
        # The leg runs from the patch at height z to the wall at 0. It crosses the edge's plane at the share to_edge /
        # dx, at height z (1 - to_edge / dx), if patch and point lie on both sides of it.
        cut = (to_edge * (optics.edge_x_m - at_x[i]) < nothing) & (z * (one - to_edge / dx) >= optics.edge_z_m)
        # Near contact as in `geometry.softened`, without its branch.
        ramp = max(one - squared / optics.near_m2, nothing)
        cosine = z if outgoing else facing
        if optics.lambertian:
            cosine = z * facing / length
        weight = light[i] * cosine / (length * (squared + soft * ramp * ramp))
        legs.weight[i] = weight if (facing > nothing) & (not cut) else nothing
        legs.length_m[i] = length
        # Sector of the horizon tables: the face by the major axis and its sign, then the tilt -1 to 1 in equal parts.
        u, v = dx * inverse_x, dy * inverse_y
        along_columns = abs(u) >= abs(v)
        major, minor = (u if along_columns else v), (v if along_columns else u)
        legs.major[i] = abs(major)
        inside = min((minor / max(abs(major), np.float32(1e-20)) + one) * half, last)
        face = (nothing if along_columns else two) + (nothing if major >= nothing else one)
        legs.sector[i] = np.int32(face * faces + np.floor(inside))


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def shade(
    legs: NumbaLegs, s: int, surface: NumbaSurface, points: NumbaPoints, start: int, count: int, field: HeightField
) -> None:
    """Set the weight of legs that the object blocks to 0."""
    z, high, low = surface.z_m[s], surface.high[s], surface.low[s]
    if not surface.shaded[s]:
        return
    # Free above the upper bound of the horizon, blocked below the lower one; in between the leg is walked. The legs
    # that are not free are listed without a branch, which would be mispredicted.
    listed = 0
    for i in range(count):
        legs.todo[listed] = i
        listed += int((z < legs.major[i] * high[np.uint32(legs.sector[i])]) & (legs.weight[i] != 0))
    for i in legs.todo[:listed]:
        sector = legs.sector[i]
        if z >= legs.major[i] * low[sector]:
            u = (points.x_m[start + i] - surface.x_m[s]) / field.pitch_x_m
            v = (surface.y_m[s] - points.y_m[start + i]) / field.pitch_y_m
            first, last = surface.walk[s, sector]
            if not blocked(field, surface.row[s], surface.column[s], z, u, v, first, last):
                continue
        legs.weight[i] = 0


@numba.njit(cache=True, inline="always")
def scratch(count: int) -> NumbaLegs:
    weight, length_m, major = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    return NumbaLegs(weight, length_m, np.empty(count, np.int32), major, np.empty(count + 1, np.int32))
