"""Legs between patches and points of the wall, compiled in float32: weight, length, and what the
object blocks.

One patch at a time with many points side by side, so that all but the walks of `shade` are vector
operations.

Last, the transport's inner loop: the sum of weighted rows of a table into one window of bins that
stays in vector registers. A compiled loop over rows that adds to an array in memory loads and
stores every bin for every row. Here the bins are values of the compiler's own vectors, so each row
costs one load and one multiply-add a vector. The rows are added in their order, bin by bin, so the
result has the bits of the plain loop. On processors with narrower vectors or without a fused
multiply-add the compiler splits the same operations.
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
BEAM_TILE = 128
"""Beams of a thread that go together: their windows of bins and their legs to some patches fit in
the first cache.
"""
RELAY_TILE = 256
"""Relay cells that go together."""
FREE = 0
MIXED = 1
DARK = 2
"""Verdicts on the legs from a patch to a tile past the object: free, some may be blocked, none
carries light.
"""
CUT = 4
"""Added to a verdict where the occluder's edge may block some legs."""


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
    highest: Float32
    """(n,); largest upper bound of any sector."""
    shaded: Mask
    """(n,); True if some leg may be blocked."""


class NumbaPoints(NamedTuple):
    """Points of the wall, laser spots or relay cells, with the leg from each to the lidar, in the
    order of tiles.
    """

    x_m: Float32
    y_m: Float32
    length_m: Float32
    weight: Float32
    soft_m2: np.float32
    place: Int32
    """(n,); place of each point here, in the order in which they were given."""
    bounds_m: Float32
    """(tiles, 4); smallest and largest x, smallest and largest y, of each tile."""
    tile: int
    """Points of a tile."""


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
    low: Int32
    """Legs that run below their horizon's upper bound: the lower bound or a walk decides them."""


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def geometry(
    legs: NumbaLegs,
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    start: int,
    count: int,
    optics: NumbaOptics,
    outgoing: bool,
) -> None:
    """Fill in the legs from patch s to points: weight before anything stands between, and length,
    vector by vector.

    Towards the lidar (`outgoing`) the weight has the wall's cosine, from it the patch's; in
    Lambertian radiometry both.
    """
    x = surface.x_m[s]
    y = surface.y_m[s]
    z = surface.z_m[s]
    nx = surface.normal_x[s]
    ny = surface.normal_y[s]
    nz = surface.normal_z[s]
    soft = points.soft_m2 if outgoing else surface.soft_m2[s]
    nothing = np.float32(0)
    one = np.float32(1)
    end = start + count
    at_x = points.x_m[start:end]
    at_y = points.y_m[start:end]
    light = points.weight[start:end]
    # S2 for one leg of length d: cosine / d^2, as facing = d cos at the patch and z = d cos at the
    # wall. No branch, so that legs are computed side by side; a leg behind the patch gets weight 0.
    for i in range(count):
        dx = at_x[i] - x
        dy = at_y[i] - y
        squared = dx * dx + dy * dy + z * z
        length = np.sqrt(squared)
        facing = nx * dx + ny * dy - nz * z
        # Near contact as in `geometry.softened`, without its branch.
        ramp = max(one - squared / optics.near_m2, nothing)
        cosine = z if outgoing else facing
        if optics.lambertian:
            cosine = z * facing / length
        weight = light[i] * cosine / (length * (squared + soft * ramp * ramp))
        legs.weight[i] = weight if facing > nothing else nothing
        legs.length_m[i] = length


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def past_edge(
    x: np.float32, z: np.float32, bounds_m: Float32, edge_x: np.float32, edge_z: np.float32
) -> int:
    """Return FREE, CUT or DARK for the legs from a patch to a tile (4,) past the occluder's
    edge.
    """
    first = (x - edge_x) * (bounds_m[0] - edge_x) < 0
    last = (x - edge_x) * (bounds_m[1] - edge_x) < 0
    # A leg to the wall's x crosses the plane x = edge at height z (1 - (edge - x_s) / (x - x_s)).
    # That is monotone in x, so over the tile it lies between its values at both ends.
    to_edge = edge_x - x
    one = np.float32(1)
    low = z * (one - to_edge / (bounds_m[0] - x))
    high = z * (one - to_edge / (bounds_m[1] - x))
    if not (first or last) or (first and last and max(low, high) < edge_z - BACK_M):
        return FREE
    return DARK if first and last and min(low, high) > edge_z + BACK_M else CUT


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def cut(legs: NumbaLegs, x: np.float32, z: np.float32, at_x: Float32, optics: NumbaOptics) -> None:
    """Set the weight of legs from a patch to points (count,) that the occluder's edge cuts to 0."""
    edge_x = optics.edge_x_m
    edge_z = optics.edge_z_m
    to_edge = edge_x - x
    one = np.float32(1)
    weights = legs.weight[: len(at_x)]
    for i in range(len(at_x)):
        # The leg runs from the patch at height z to the wall at 0. It crosses the edge's plane at
        # the share to_edge / dx, at height z (1 - to_edge / dx), if patch and point lie on both
        # sides of it.
        beyond = to_edge * (edge_x - at_x[i]) < 0
        blocked = beyond & (z * (one - to_edge / (at_x[i] - x)) >= edge_z)
        weights[i] = np.float32(0) if blocked else weights[i]


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def past_object(
    s: int,
    surface: NumbaSurface,
    ends_m: tuple[np.float32, np.float32, np.float32, np.float32],
    pitches: tuple[np.float32, np.float32],
    sectors: int,
) -> int:
    """Return FREE, MIXED or DARK for the legs from patch s to a tile, whose ends are given from the
    patch on.

    What holds at the tile's corners holds inside. `ends_m` are left, right, lower and upper end;
    `pitches` are the inverse ones of the depth map's cells.
    """
    left, right, below, above = ends_m
    z = surface.z_m[s]
    nx = surface.normal_x[s]
    ny = surface.normal_y[s]
    nothing = np.float32(0)
    one = np.float32(1)
    # Facing is linear over the tile, so it is largest at a corner.
    if max(nx * left, nx * right) + max(ny * below, ny * above) - surface.normal_z[s] * z < -BACK_M:
        return DARK
    if sectors == 0 or not surface.shaded[s]:
        return FREE
    u_low = left * pitches[0]
    u_high = right * pitches[0]
    v_low = -above * pitches[1]
    v_high = -below * pitches[1]
    near_u = max(u_low, -u_high, nothing)
    near_v = max(v_low, -v_high, nothing)
    far_u = max(-u_low, u_high)
    far_v = max(-v_low, v_high)
    # A leg over u cells along its major axis is free if z >= u h (see `visibility`).
    if z >= max(far_u, far_v) * surface.highest[s] * (one + SLACK):
        return FREE
    along_columns = near_u > far_v
    if not along_columns and near_v <= far_u:  # the tile meets several faces
        return MIXED
    major_low, major_high = (near_u, far_u) if along_columns else (near_v, far_v)
    low, high = (v_low, v_high) if along_columns else (u_low, u_high)
    # The tilt is the quotient of both axes: largest and smallest at corners. A sector more covers
    # rounding.
    least = low / (major_high if low >= 0 else major_low)
    most = high / (major_low if high >= 0 else major_high)
    half = np.float32(sectors / 2)
    face = 0 if along_columns else 2
    face += 0 if (u_high if along_columns else v_high) > 0 else 1
    first = face * sectors + max(int(np.floor((least + one) * half)) - 1, 0)
    last = face * sectors + min(int(np.floor((most + one) * half)) + 1, sectors - 1)
    # Every leg to the tile has its horizon within the bounds of these sectors.
    highest = nothing
    lowest = np.float32(np.inf)
    for sector in range(first, last + 1):
        highest = max(highest, surface.high[s, sector])
        lowest = min(lowest, surface.low[s, sector])
    if z >= major_high * highest * (one + SLACK):
        return FREE
    return DARK if z < major_low * lowest * (one - SLACK) else MIXED


@inner(error_model="numpy", fastmath=FAST)
def judge(
    begin: int,
    end: int,
    surface: NumbaSurface,
    bounds_m: Float32,
    optics: NumbaOptics,
    field: HeightField,
) -> NDArray[np.int8]:
    """Return verdicts (end - begin, tiles) on the legs from some patches to tiles (tiles, 4)."""
    # One verdict spares the test of each leg in the tile; most tiles are wholly free or dark.
    verdicts = np.empty((end - begin, len(bounds_m)), np.int8)
    pitches = np.float32(1 / field.pitch_x_m), np.float32(1 / field.pitch_y_m)
    for s in range(begin, end):
        x = surface.x_m[s]
        y = surface.y_m[s]
        for tile in range(len(bounds_m)):
            bounds = bounds_m[tile]
            by_edge = past_edge(x, surface.z_m[s], bounds, optics.edge_x_m, optics.edge_z_m)
            ends_m = bounds[0] - x, bounds[1] - x, bounds[2] - y, bounds[3] - y
            by_object = past_object(s, surface, ends_m, pitches, optics.sectors)
            dark = DARK in (by_edge, by_object)
            verdicts[s - begin, tile] = DARK if dark else by_edge + by_object
    return verdicts


BACK_M = np.float32(1e-5)
"""Height, above the rounding of float32, by which a tile lies behind a patch's plane before its
legs are left out.
"""
SLACK = np.float32(1e-5)
"""Relative widening of the verdicts, above the rounding of float32."""


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def fill(
    legs: NumbaLegs,
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    start: int,
    count: int,
    verdict: int,
    optics: NumbaOptics,
    field: HeightField,
    outgoing: bool,
) -> None:
    """Fill in the legs from patch s to the points of a tile of that verdict, from `start` on."""
    geometry(legs, s, surface, points, start, count, optics, outgoing)
    if verdict != FREE:
        end = start + count
        block(
            verdict, legs, s, surface, points.x_m[start:end], points.y_m[start:end], optics, field
        )


@inner(error_model="numpy", fastmath=FAST)
def fill_all(
    legs: NumbaLegs,
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    outgoing: bool,
) -> None:
    """Fill in the legs from patch s to all points, with the lengths of legs that carry no light
    too.
    """
    geometry(legs, s, surface, points, 0, len(points.x_m), optics, outgoing)
    verdicts = judge(s, s + 1, surface, points.bounds_m, optics, field)[0]
    for tile in range(len(verdicts)):
        begin = tile * points.tile
        end = min(begin + points.tile, len(points.x_m))
        if verdicts[tile] == DARK:
            legs.weight[begin:end] = 0
        elif verdicts[tile] != FREE:
            own = NumbaLegs(
                legs.weight[begin:end],
                legs.length_m[begin:end],
                legs.sector[begin:end],
                legs.major[begin:end],
                legs.low[begin : end + 1],
            )
            at_x = points.x_m[begin:end]
            at_y = points.y_m[begin:end]
            block(verdicts[tile], own, s, surface, at_x, at_y, optics, field)


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def block(
    verdict: int,
    legs: NumbaLegs,
    s: int,
    surface: NumbaSurface,
    at_x: Float32,
    at_y: Float32,
    optics: NumbaOptics,
    field: HeightField,
) -> None:
    """Set the weight of blocked legs from patch s to points (count,) to 0."""
    if verdict >= CUT:
        cut(legs, surface.x_m[s], surface.z_m[s], at_x, optics)
    if verdict != CUT:
        shade(legs, s, surface, at_x, at_y, optics, field)


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def shade(
    legs: NumbaLegs,
    s: int,
    surface: NumbaSurface,
    at_x: Float32,
    at_y: Float32,
    optics: NumbaOptics,
    field: HeightField,
) -> None:
    """Set the weight of legs from patch s to points (count,) that the object blocks to 0."""
    count = len(at_x)
    x = surface.x_m[s]
    y = surface.y_m[s]
    z = surface.z_m[s]
    high = surface.high[s]
    low = surface.low[s]
    nothing = np.float32(0)
    one = np.float32(1)
    two = np.float32(2)
    inverse_x = np.float32(1 / field.pitch_x_m)
    inverse_y = np.float32(-1 / field.pitch_y_m)  # rows run along -y
    half = np.float32(optics.sectors / 2)
    last = np.float32(optics.sectors - 1)
    faces = np.float32(optics.sectors)
    majors = legs.major[:count]
    sectors = legs.sector[:count]
    weights = legs.weight[:count]
    for i in range(count):
        # Sector of the horizon tables: the face by the major axis and its sign, then the tilt -1 to
        # 1 in equal parts.
        u = (at_x[i] - x) * inverse_x
        v = (at_y[i] - y) * inverse_y
        along_columns = abs(u) >= abs(v)
        major = u if along_columns else v
        minor = v if along_columns else u
        majors[i] = abs(major)
        inside = min((minor / max(abs(major), np.float32(1e-20)) + one) * half, last)
        face = (nothing if along_columns else two) + (nothing if major >= nothing else one)
        sectors[i] = np.int32(face * faces + np.floor(inside))
    # Free above the upper bound of the horizon, blocked below the lower one; in between the leg is
    # walked. The legs that are not free are listed without a branch, which would be mispredicted.
    below = 0
    for i in range(count):
        legs.low[below] = i
        below += int((z < majors[i] * high[np.uint32(sectors[i])]) & (weights[i] != 0))

    for i in legs.low[:below]:
        sector = sectors[i]
        if z >= majors[i] * low[sector]:
            # In float64, as the reference walks it: the bounds only choose which legs are walked.
            u = (at_x[i] - surface.x_m[s]) / field.pitch_x_m
            v = (surface.y_m[s] - at_y[i]) / field.pitch_y_m
            steps = surface.walk[s, sector]
            if not blocked(field, surface.row[s], surface.column[s], z, u, v, steps[0], steps[1]):
                continue
        weights[i] = 0


@numba.njit(cache=True, inline="always")
def scratch(count: int) -> NumbaLegs:
    """Return empty legs to `count` points."""
    weight = np.empty(count, np.float32)
    length_m = np.empty(count, np.float32)
    sector = np.empty(count, np.int32)
    major = np.empty(count, np.float32)
    # One more: a leg is listed before it is known to be low, and the next one takes its place.
    low = np.empty(count + 1, np.int32)
    return NumbaLegs(weight, length_m, sector, major, low)


WINDOW = 32
"""Bins of one sum: four vectors of 8, enough to hide the latency of their multiply-adds."""
VECTOR = 8
"""32-bit numbers of one vector: wider ones cross a cache line at every odd start, and gain
nothing.
"""
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
    """Add `count` rows of WINDOW bins, times their weights, to sums[at : at + WINDOW]; all arrays
    are flat.

    Row j begins at table[base[j] + offset[first + j * step]] and has the weight weight[first + j *
    step].
    """
    columns = sums, at, table, base, offset, weight, first, step, count

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        arrays = [
            context.make_array(kind)(context, builder, arg).data
            if isinstance(kind, types.Array)
            else arg
            for kind, arg in zip(signature.args, args, strict=True)
        ]
        target, place, rows, starts, offsets, weights, begin, stride, number = arrays
        # The compiler's own multiply-add: one instruction where the processor has it, two
        # operations elsewhere.
        vector = ir.VectorType(ir.FloatType(), VECTOR)
        name = f"llvm.fmuladd.v{VECTOR}f32"
        multiply_add = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(vector, [vector] * 3), name
        )
        undefined = ir.Constant(vector, ir.Undefined)
        same = ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), None)

        def part(pointer: Any, k: int) -> Any:
            return builder.bitcast(builder.gep(pointer, [_INDEX(VECTOR * k)]), vector.as_pointer())

        target = builder.gep(target, [place])
        # Independent accumulators: a multiply-add takes about four cycles, and a single chain of
        # them would leave the unit idle while it waits for its own result. The compiler turns these
        # variables into registers.
        bins = [cgutils.alloca_once(builder, vector) for _ in range(WINDOW // VECTOR)]
        for k, variable in enumerate(bins):
            builder.store(builder.load(part(target, k), align=4), variable)
        with cgutils.for_range(builder, number, intp=_INDEX) as loop:
            j = builder.add(begin, builder.mul(loop.index, stride))
            offset_j = builder.sext(builder.load(builder.gep(offsets, [j])), _INDEX)
            row = builder.gep(
                rows, [builder.add(builder.load(builder.gep(starts, [loop.index])), offset_j)]
            )
            # Rows are aligned to a number, not to a vector: any shift in bins must be possible.
            # The weight goes into every lane of a vector.
            lone = builder.insert_element(
                undefined, builder.load(builder.gep(weights, [j])), ir.IntType(32)(0)
            )
            factor = builder.shuffle_vector(lone, undefined, same)
            for k, variable in enumerate(bins):
                terms = factor, builder.load(part(row, k), align=4), builder.load(variable)
                builder.store(builder.call(multiply_add, terms), variable)
        for k, variable in enumerate(bins):
            builder.store(builder.load(variable), part(target, k), align=4)
        return context.get_dummy_value()

    return types.void(*columns), generate


add_rows = cast("Callable[..., None]", intrinsic(_add_rows))
