"""Legs between patches and points of the wall, compiled in float32: weight, length, and what the object blocks.

One patch at a time with many points side by side, so that all but the walks of `shade` are vector operations.

Last, the transport's inner loop: the sum of weighted rows of a table into one window of bins that stays in vector
registers. A compiled loop over rows that adds to an array in memory loads and stores every bin for every row. Here the
bins are values of the compiler's own vectors, so each row costs one load and one multiply-add a vector. The rows are
added in their order, bin by bin, so the result has the bits of the plain loop. On processors with narrower vectors or
without a fused multiply-add the compiler splits the same operations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from llvmlite import ir
from nlos_calibration.arrays import Float32, Int32, Mask
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from nlos_cam.frames import inner
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


@inner(error_model="numpy", fastmath=FAST)
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
            first, last = surface.walk[s, sector, 0], surface.walk[s, sector, 1]
            if not blocked(field, surface.row[s], surface.column[s], z, u, v, first, last):
                continue
        legs.weight[i] = 0


@numba.njit(cache=True, inline="always")
def scratch(count: int) -> NumbaLegs:
    weight, length_m, major = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    return NumbaLegs(weight, length_m, np.empty(count, np.int32), major, np.empty(count + 1, np.int32))


WINDOW = 32
"""Bins of one sum: four vectors of 8, enough to hide the latency of their multiply-adds."""
VECTOR = 8
"""32-bit numbers of one vector: wider ones cross a cache line at every odd start, and gain nothing."""
_INDEX = ir.IntType(64)


def _add_rows(
    _context: Any,
    sums: Any,
    at: Any,
    table: Any,
    base: Any,
    offset: Any,
    weight: Any,
    first: Any,
    step: Any,
    count: Any,
) -> tuple[Any, Callable[..., Any]]:
    """Add `count` rows of WINDOW bins, times their weights, to sums[at : at + WINDOW]; all arrays are flat.

    Row j begins at table[base[j] + offset[first + j * step]] and has the weight weight[first + j * step].
    """
    columns = sums, at, table, base, offset, weight, first, step, count

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        arrays = [
            context.make_array(kind)(context, builder, arg).data if isinstance(kind, types.Array) else arg
            for kind, arg in zip(signature.args, args, strict=True)
        ]
        target, place, rows, starts, offsets, weights, begin, stride, number = arrays
        vector = ir.VectorType(ir.FloatType(), VECTOR)
        name = f"llvm.fmuladd.v{VECTOR}f32"
        multiply_add = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
        undefined, same = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), None)

        def part(pointer: Any, k: int) -> Any:
            return builder.bitcast(builder.gep(pointer, [_INDEX(VECTOR * k)]), vector.as_pointer())

        target = builder.gep(target, [place])
        # Independent accumulators: a multiply-add takes about four cycles, and a single chain of them would leave the
        # unit idle while it waits for its own result. The compiler turns these variables into registers.
        bins = [cgutils.alloca_once(builder, vector) for _ in range(WINDOW // VECTOR)]
        for k, variable in enumerate(bins):
            builder.store(builder.load(part(target, k), align=4), variable)
        with cgutils.for_range(builder, number, intp=_INDEX) as loop:
            j = builder.add(begin, builder.mul(loop.index, stride))
            offset_j = builder.sext(builder.load(builder.gep(offsets, [j])), _INDEX)
            row = builder.gep(rows, [builder.add(builder.load(builder.gep(starts, [loop.index])), offset_j)])
            # Rows are aligned to a number, not to a vector: any shift in bins must be possible.
            lone = builder.insert_element(undefined, builder.load(builder.gep(weights, [j])), ir.IntType(32)(0))
            factor = builder.shuffle_vector(lone, undefined, same)
            for k, variable in enumerate(bins):
                terms = factor, builder.load(part(row, k), align=4), builder.load(variable)
                builder.store(builder.call(multiply_add, terms), variable)
        for k, variable in enumerate(bins):
            builder.store(builder.load(variable), part(target, k), align=4)
        return context.get_dummy_value()

    return types.void(*columns), generate


add_rows = cast("Callable[..., None]", intrinsic(_add_rows))
