"""Glossy surfaces on the CPU: the lobe of a BRDF on a lattice of directions for each patch.

A BRDF couples both legs at a patch, so S2 no longer factorizes there. Its diffuse part still does.
The lobe, gain (u . v)^n, is a smooth function of the direction u of the light that arrives: a
patch has one table of returns for each node of a lattice of directions, weighted by the lobe about
that node, and a beam adds the tables of the 4 x 4 nodes around its own direction with the weights
of cubic interpolation. A narrower lobe needs more nodes, in proportion to n, and each meets fewer
cells of the wall, in proportion to 1 / n: the tables cost nearly the same for any exponent.
"""

from math import sqrt
from typing import Any, NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int32, Int64

from nlos_cam.frames import inner
from nlos_cam.render.backend_numba import NumbaJob, check_tables, returns
from nlos_cam.render.beam_sums import ROUNDED, NumbaGroups, NumbaTables, ends
from nlos_cam.render.echoes import MultiBounce, strongest
from nlos_cam.render.job import TransportJob
from nlos_cam.render.legs import (
    BEAM_TILE,
    DARK,
    FAST,
    WINDOW,
    NumbaOptics,
    NumbaPoints,
    NumbaSurface,
    add_rows,
    fill,
    judge,
    scratch,
)
from nlos_cam.render.material import Brdf, phong
from nlos_cam.render.visibility import HeightField

IN_ORDER = FAST - {"reassoc"}
"""Liberties of the compiler, without that of the order of a sum. Each function is compiled into
every one that calls it: with it the copies round apart, and the process that compiles the kernels
had other last bits than those that load them.
"""
LANES = 8
"""Nodes whose tables are counted together: one vector of float32."""
CHUNK = 16
"""Relay cells that are left out together where they lie beyond a lobe."""
NEIGHBORS = 16
"""Nodes of one interpolation, 4 x 4."""
INTERPOLATION = 0.05
"""Error of the interpolation (relative L1 of the lobe) where nodes lie one standard deviation of
the lobe apart.
"""
LOWERED = 11 / 720
"""Mean of (t + 1) t (t - 1) (t - 2) / 4! for t from 0 to 1: cubic interpolation through nodes h
apart lies that times h^4 and the fourth derivative below a function, on average.
"""
MAX_STEP = 0.25
"""Largest step of a lattice, so that two nodes beyond the horizon (at sqrt 2) still lie before the
map's own edge (at 2).
"""
SMALLEST_RAISED = np.float32(1e-4)
"""Smaller factors are left out."""
CUT_SHARE = 1 / 30
"""Share of the accuracy's error that may be lost by cutting the lobe off."""
TABLE_BYTES = 1 << 20
"""Memory for the tables of the patches whose rows are added together: the second cache."""


class Lobe(NamedTuple):
    """Lobe of a BRDF for compiled loops, with the lattice on which it is interpolated."""

    diffuse: np.float32
    gain: np.float32
    whole: int
    """Whole part of the exponent."""
    fraction: int
    """Rest of the exponent, in 1 / 256."""
    mirrored: bool
    """True for a lobe about the mirror direction, False for one about the incoming light."""
    cut: np.float32
    """Smallest cosine to the lobe's axis that counts."""
    step: np.float32
    """Step of the lattice, in the plane of `_on_plane`."""
    raised: np.float32
    """LOWERED times the fourth power of the step in standard deviations of the lobe."""


class Cells(NamedTuple):
    """Relay cells to which a patch sends light, in whole chunks; the rest of the last is dark."""

    x: Float32
    """(n,); unit vectors from the patch."""
    y: Float32
    z: Float32
    weight: Float32
    sub_bin: Int32


class Chunks(NamedTuple):
    """Chunks (k) of cells: every unit vector lies within `reach` of the mean."""

    x: Float32
    y: Float32
    z: Float32
    reach: Float32


def lobe_of(brdf: Brdf, error: float) -> Lobe:
    """Return the lobe of a BRDF for an error (relative L1) of the whole BRDF's values."""
    # cos^n theta = exp(n log cos theta) is nearly exp(-n theta^2 / 2).
    deviation = 1 / sqrt(brdf.exponent)
    # Cubic interpolation errs by the fourth power of the step. The error may be larger where the
    # lobe is but a part of the light.
    share = max(brdf.specular / max(brdf.diffuse + brdf.specular, 1e-9), 1e-9)
    step = min(deviation * (error / share / INTERPOLATION) ** 0.25, MAX_STEP)
    # The integral of cos^n beyond the angle where it is e is about e of the whole: with c = cos,
    # the integral of c^n dc from 0 to e^(1 / n) is e^(1 + 1 / n) / (n + 1).
    cut = (error * CUT_SHARE) ** (1 / brdf.exponent)
    units = round(brdf.exponent * 256)
    return Lobe(
        np.float32(brdf.diffuse),
        np.float32(brdf.gain),
        units // 256,
        units % 256,
        brdf.mirrored,
        np.float32(cut),
        np.float32(step),
        np.float32(LOWERED * (step / deviation) ** 4),
    )


@numba.njit(cache=True, error_model="numpy", inline="always")
def _on_plane(
    dx: np.float32, dy: np.float32, z: np.float32, step: np.float32
) -> tuple[np.float32, np.float32]:
    """Return where the direction from a patch at height z to a point of the wall lies, in steps.

    The map is Lambert's equal-area one about the wall's normal: its radius is 2 sin(theta / 2), so
    a lobe covers about the same area wherever it points.
    """
    one = np.float32(1)
    inverse = one / np.sqrt(max(dx * dx + dy * dy + z * z, np.float32(1e-20)))
    # sin(theta) / (2 sin(theta / 2)) = cos(theta / 2) = sqrt((1 + cos theta) / 2)
    scale = inverse * np.sqrt(np.float32(2) / (one + z * inverse)) / step
    return dx * scale, dy * scale


@numba.njit(cache=True, error_model="numpy", inline="always")
def _axis(
    i: int, j: int, s: int, surface: NumbaSurface, lobe: Lobe
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the unit vector of the lobe of light that arrives from a node of the lattice, and the
    factor `raised` there.
    """
    x = np.float32(i) * lobe.step
    y = np.float32(j) * lobe.step
    squared = x * x + y * y
    one = np.float32(1)
    half = np.float32(0.5)
    # The inverse of `_on_plane`: cos theta = 1 - r^2 / 2, and sin theta / r = sqrt(1 - r^2 / 4).
    scale = np.sqrt(max(one - squared * half * half, np.float32(0)))
    x *= scale
    y *= scale
    z = squared * half - one
    # A step is longer by 1 / cos(theta / 2) along the radius and shorter by as much across it.
    stretch = max(scale, half) ** 4
    raised = lobe.raised * (stretch + one / stretch) * half
    if lobe.mirrored:
        nx = surface.normal_x[s]
        ny = surface.normal_y[s]
        nz = surface.normal_z[s]
        twice = np.float32(2) * (x * nx + y * ny + z * nz)
        return twice * nx - x, twice * ny - y, twice * nz - z, raised
    return x, y, z, raised


@numba.njit(cache=True, error_model="numpy", inline="always")
def _weights(at: np.float32, weight: Float32) -> None:
    """Fill in Lagrange's weights (4,) of the nodes -1, 0, 1, 2 for a place from 0 to 1."""
    # Of node k: the product over the other nodes j of (at - j) / (k - j).
    one = np.float32(1)
    two = np.float32(2)
    six = np.float32(6)
    weight[0] = -at * (at - one) * (at - two) / six
    weight[1] = (at + one) * (at - one) * (at - two) / two
    weight[2] = -(at + one) * at * (at - two) / two
    weight[3] = (at + one) * at * (at - one) / six


@inner(error_model="numpy", fastmath=IN_ORDER)
def _multiply_roots(values: Float32, base: Float32, fraction: int) -> None:
    """Multiply by the base to a power in 1 / 256: a square root for each binary digit."""
    root = base.copy()
    digit = 128
    while fraction:
        for i in range(len(values)):
            root[i] = np.sqrt(root[i])
        if fraction & digit:
            for i in range(len(values)):
                values[i] *= root[i]
            fraction -= digit
        digit >>= 1


@inner(error_model="numpy", fastmath=IN_ORDER)
def _power(values: Float32, lobe: Lobe, square: Float32) -> None:
    """Raise cosines to the lobe's exponent, in place, and set those below its cut to 0."""
    # By repeated squaring: whole vectors of products, where a logarithm would be a call for each.
    # Cosines below the cut, negative ones among them, are 0 to any power: no root of them either.
    for i in range(len(values)):
        square[i] = values[i] if values[i] >= lobe.cut else np.float32(0)
        values[i] = np.float32(1) if values[i] >= lobe.cut else np.float32(0)
    if lobe.fraction:
        _multiply_roots(values, square, lobe.fraction)
    left = lobe.whole
    while left:
        if left & 1:
            for i in range(len(values)):
                values[i] *= square[i]
        left >>= 1
        if left:
            for i in range(len(values)):
                square[i] *= square[i]


@inner(error_model="numpy")
def _cells(
    s: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    start: np.float32,
    sub_bins: int,
) -> Cells:
    """Return the relay cells to which a patch sends light, with sub-bins from `start` on."""
    # Dark cells are dropped and the others packed, so that every node of the lattice goes over
    # whole vectors of light alone. The last chunk is filled up with weight 0.
    room = len(relay.x_m) + CHUNK
    cells = Cells(
        np.zeros(room, np.float32),
        np.zeros(room, np.float32),
        np.zeros(room, np.float32),
        np.zeros(room, np.float32),
        np.zeros(room, np.int32),
    )
    legs = scratch(relay.tile)
    verdicts = judge(s, s + 1, surface, relay.bounds_m, optics, field)[0]
    found = 0
    for tile in range(len(verdicts)):
        begin = tile * relay.tile
        count = returns(verdicts[tile], legs, s, begin, surface, relay, optics, field)
        for i in range(count):
            at = int(legs.length_m[i] - start)
            if legs.weight[i] > 0 and at < sub_bins:
                dx = relay.x_m[begin + i] - surface.x_m[s]
                dy = relay.y_m[begin + i] - surface.y_m[s]
                z = surface.z_m[s]
                inverse = np.float32(1) / np.sqrt(max(dx * dx + dy * dy + z * z, np.float32(1e-20)))
                cells.x[found] = dx * inverse
                cells.y[found] = dy * inverse
                cells.z[found] = -z * inverse
                cells.weight[found] = legs.weight[i]
                cells.sub_bin[found] = at
                found += 1
    whole = (found + CHUNK - 1) // CHUNK * CHUNK
    return Cells(
        cells.x[:whole],
        cells.y[:whole],
        cells.z[:whole],
        cells.weight[:whole],
        cells.sub_bin[:whole],
    )


@inner(error_model="numpy")
def _chunks(cells: Cells) -> Chunks:
    """Return the mean unit vector of each chunk of cells, and how far from it any of them lies."""
    # Cells of a chunk are near one another on the wall: their directions lie close together.
    count = len(cells.x) // CHUNK
    chunks = Chunks(
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
    )
    for k in range(count):
        some = slice(k * CHUNK, (k + 1) * CHUNK)
        x = cells.x[some].sum() / np.float32(CHUNK)
        y = cells.y[some].sum() / np.float32(CHUNK)
        z = cells.z[some].sum() / np.float32(CHUNK)
        farthest = np.float32(0)
        for i in range(k * CHUNK, (k + 1) * CHUNK):
            if cells.weight[i] > 0:
                off = (cells.x[i] - x) ** 2 + (cells.y[i] - y) ** 2 + (cells.z[i] - z) ** 2
                farthest = max(farthest, np.float32(off))
        chunks.x[k] = x
        chunks.y[k] = y
        chunks.z[k] = z
        # With room for the rounding of float32, so that a bound by it is never too low.
        chunks.reach[k] = np.sqrt(farthest) + np.float32(1e-5)
    return chunks


@inner(error_model="numpy", fastmath=IN_ORDER)
def _fill_raised(cosines: Float32, factors: Float32, lobe: Lobe, raised: Float32) -> None:
    """Fill in the factors by which a lobe's values are raised at some cosines to its axes."""
    raised[:] = 1
    if lobe.raised < SMALLEST_RAISED:
        return
    one = np.float32(1)
    six = np.float32(6)
    three_quarters = np.float32(0.75)
    twice = np.float32(2 * lobe.whole)
    # Interpolation is too low by LOWERED h^4 times the fourth derivative, so the nodes are raised
    # by as much: what is added is interpolated along with them.
    # With R = n theta^2 = 2 n (1 - cos theta) the lobe is nearly exp(-R / 2), and the sum of its
    # fourth derivatives along both axes is (6 - 6 R + 3/4 R^2) f, averaged over the turn of the
    # axes, in units of its standard deviation.
    for i in range(CHUNK):
        for lane in range(LANES):
            r = twice * (one - cosines[i * LANES + lane])
            terms = six - six * r + three_quarters * r * r
            raised[i * LANES + lane] += factors[lane] * terms


@inner(error_model="numpy", fastmath=IN_ORDER)
def _count(
    axes: Float32,
    lobe: Lobe,
    cells: Cells,
    chunks: Chunks,
    counted: Float32,
    values: Float32,
    square: Float32,
) -> tuple[int, int]:
    """Count the light of the cells in sub-bins (n, LANES), weighted by the lobes about some axes.

    Return the first sub-bin with light, and the one after the last. `axes` is (4, LANES): unit
    vectors, and the factor `raised`.
    """
    first = len(counted)
    last = 0
    raised = np.empty(CHUNK * LANES, np.float32)
    for k in range(len(chunks.x)):
        # |u . v - u . m| <= |v - m| <= reach for unit vectors u: if the nearest axis is farther
        # from the mean m, no cosine of the chunk reaches the cut.
        near = np.float32(-2)
        for lane in range(LANES):
            near = max(
                near,
                axes[0, lane] * chunks.x[k]
                + axes[1, lane] * chunks.y[k]
                + axes[2, lane] * chunks.z[k],
            )
        if near + chunks.reach[k] < lobe.cut:
            continue
        for i in range(CHUNK):
            x = cells.x[k * CHUNK + i]
            y = cells.y[k * CHUNK + i]
            z = cells.z[k * CHUNK + i]
            for lane in range(LANES):
                values[i * LANES + lane] = axes[0, lane] * x + axes[1, lane] * y + axes[2, lane] * z
        _fill_raised(values, axes[3], lobe, raised)
        _power(values, lobe, square)
        for i in range(CHUNK * LANES):
            values[i] *= raised[i]
        for i in range(CHUNK):
            at = cells.sub_bin[k * CHUNK + i]
            weight = cells.weight[k * CHUNK + i]
            if weight > 0:
                first = min(first, at)
                last = max(last, at + 1)
                for lane in range(LANES):
                    counted[at, lane] += weight * values[i * LANES + lane]
    return first, last


@inner(error_model="numpy", fastmath=IN_ORDER)
def _as_rows(
    counted: Float32,
    total: Float64,
    first: int,
    last: int,
    per_bin: int,
    rows: Float32,
    rest: Float32,
) -> None:
    """Fill in rows (LANES, per_bin, WINDOW + width) and bounds (LANES, bins + 1) from sub-bins.

    Clears the sub-bins. `rest` is the largest bin of any shift from a bin on.
    """
    bins = rest.shape[1] - 1
    width = rows.shape[2] - WINDOW
    rows[:] = 0
    rest[:] = 0
    if first >= last:
        return
    # A shift takes sub-bins up to per_bin - 1 earlier: light of bin `last` may fall one bin later.
    begin = first // per_bin
    end = min((last + per_bin - 1) // per_bin + 1, bins)
    low = max(begin - 1, 0) * per_bin
    high = end * per_bin
    for lane in range(LANES):
        # float64, so that the difference of large sums keeps the small bins.
        running = 0.0
        for k in range(low, high):
            total[lane, k] = running
            running += counted[k, lane]
            counted[k, lane] = 0
        total[lane, high] = running
    # Bin i at a shift is the sum over the sub-bins [i per_bin - shift, (i + 1) per_bin - shift).
    for lane in range(LANES):
        for shift in range(per_bin):
            before = total[lane, max(begin * per_bin - shift, low)]
            for i in range(begin, end):
                after = total[lane, (i + 1) * per_bin - shift]
                value = np.float32(after - before)
                before = after
                rest[lane, i] = max(rest[lane, i], value)
                if i < width:
                    rows[lane, shift, WINDOW + i] = value
        # From the last bin backwards: the largest of this bin and all later ones.
        for i in range(end - 1, -1, -1):
            rest[lane, i] = max(rest[lane, i], rest[lane, i + 1])


class Lattices(NamedTuple):
    """Nodes of each patch (n) between which some beam interpolates."""

    corner: Int32
    """(n, 4); first column and row, and the numbers of columns and rows."""
    place: Int32
    """(n, nodes); place of each node among those needed, column by column, or -1."""
    needed: Int32
    """(n,); nodes needed."""


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _places(surface: NumbaSurface, feet: NumbaPoints, lobe: Lobe, corners: Int32) -> Lattices:
    """Return the lattices with those corners."""
    patches = len(corners)
    most = (corners[:, 2] * corners[:, 3]).max()
    place = np.full((patches, most), np.int32(-1))
    count = np.zeros(patches, np.int32)
    for s in numba.prange(patches):
        columns = corners[s, 2]
        rows = corners[s, 3]
        some = np.zeros((columns, rows), np.bool_)
        for i in range(len(feet.x_m)):
            x, y = _on_plane(
                feet.x_m[i] - surface.x_m[s],
                feet.y_m[i] - surface.y_m[s],
                surface.z_m[s],
                lobe.step,
            )
            some[int(np.floor(x)) - corners[s, 0], int(np.floor(y)) - corners[s, 1]] = True
        # Cubic interpolation takes the nodes -1 to 2 around each cell with a beam.
        needed = np.zeros((columns, rows), np.bool_)
        for i in range(1, columns - 2):
            for j in range(1, rows - 2):
                if some[i, j]:
                    needed[i - 1 : i + 3, j - 1 : j + 3] = True
        for i in range(columns):
            for j in range(rows):
                if needed[i, j]:
                    place[s, i * rows + j] = count[s]
                    count[s] += 1
    return Lattices(corners, place, count)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _corners(surface: NumbaSurface, feet: NumbaPoints, lobe: Lobe) -> Int32:
    """Return the first column and row of each patch's lattice and their numbers (n, 4)."""
    corners = np.zeros((len(surface.x_m), 4), np.int32)
    for s in numba.prange(len(surface.x_m)):
        low_x = np.float32(np.inf)
        low_y = np.float32(np.inf)
        high_x = np.float32(-np.inf)
        high_y = np.float32(-np.inf)
        for i in range(len(feet.x_m)):
            x, y = _on_plane(
                feet.x_m[i] - surface.x_m[s],
                feet.y_m[i] - surface.y_m[s],
                surface.z_m[s],
                lobe.step,
            )
            low_x = min(low_x, x)
            low_y = min(low_y, y)
            high_x = max(high_x, x)
            high_y = max(high_y, y)
        # One node before the first cell with a beam, and two after the corner of the last.
        corners[s, 0] = int(np.floor(low_x)) - 1
        corners[s, 1] = int(np.floor(low_y)) - 1
        corners[s, 2] = int(np.floor(high_x)) + 3 - corners[s, 0]
        corners[s, 3] = int(np.floor(high_y)) + 3 - corners[s, 1]
    return corners


@inner(error_model="numpy", fastmath=IN_ORDER)
def _patch_rows(
    s: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    lobe: Lobe,
    lattices: Lattices,
    table: NumbaTables,
    rows: Float32,
    rest: Float32,
) -> None:
    """Fill in the rows (nodes, per_bin, WINDOW + width) of one patch: diffuse first, then nodes."""
    per_bin = table.per_bin
    sub_bins = table.width * per_bin
    start = np.float32(table.first[s] * per_bin)
    cells = _cells(s, surface, relay, optics, field, start, sub_bins)
    counted = np.zeros((sub_bins, LANES), np.float32)
    total = np.empty((LANES, sub_bins + 1))
    # The first LANES places belong to the diffuse part, in the first of them.
    first = sub_bins
    last = 0
    for i in range(len(cells.x)):
        if cells.weight[i] > 0:
            at = cells.sub_bin[i]
            counted[at, 0] += cells.weight[i]
            first = min(first, at)
            last = max(last, at + 1)
    _as_rows(counted, total, first, last, per_bin, rows[:LANES], rest[:LANES])
    if lobe.gain == 0:
        return

    # Then the needed nodes, LANES at a time; the last vector may not be full, and its spare lanes
    # keep the axes of earlier nodes: no beam reads their rows.
    chunks = _chunks(cells)
    axes = np.zeros((4, LANES), np.float32)
    values = np.empty(CHUNK * LANES, np.float32)
    square = np.empty(CHUNK * LANES, np.float32)
    corner = lattices.corner[s]
    node = 0
    for k in range(corner[2] * corner[3]):
        if lattices.place[s, k] < 0:
            continue
        x, y, z, raised = _axis(
            corner[0] + k // corner[3], corner[1] + k % corner[3], s, surface, lobe
        )
        lane = node % LANES
        axes[0, lane] = x
        axes[1, lane] = y
        axes[2, lane] = z
        axes[3, lane] = raised
        node += 1
        if node % LANES and node < lattices.needed[s]:
            continue
        first, last = _count(axes, lobe, cells, chunks, counted, values, square)
        begin = (node + LANES - 1) // LANES * LANES
        _as_rows(
            counted,
            total,
            first,
            last,
            per_bin,
            rows[begin : begin + LANES],
            rest[begin : begin + LANES],
        )


@numba.njit(cache=True, parallel=True)
def _rows(
    begin: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    lobe: Lobe,
    lattices: Lattices,
    table: NumbaTables,
    rows: Float32,
    rest: Float32,
) -> None:
    """Fill in the rows of some patches, and bounds on their bins."""
    for j in numba.prange(len(rows)):
        s = begin + j
        _patch_rows(
            s,
            surface,
            relay,
            optics,
            field,
            lobe,
            lattices,
            table,
            rows[j],
            rest[j],
        )


@numba.njit(cache=True, parallel=True)
def _begins(
    feet: NumbaPoints,
    groups: NumbaGroups,
    centers: NumbaSurface,
    optics: NumbaOptics,
    table: NumbaTables,
) -> tuple[Float32, int]:
    """Return a bin (n,) before every path of each beam, and the bins from there to the last path of
    any.
    """
    beams = len(feet.x_m)
    tiles = (beams + BEAM_TILE - 1) // BEAM_TILE
    begin = np.zeros(beams, np.float32)
    bins = np.zeros(tiles, np.int64)
    for tile in numba.prange(tiles):
        start = tile * BEAM_TILE
        near, bins[tile] = ends(
            start, min(BEAM_TILE, beams - start), feet, groups, centers, optics, table
        )
        for i in range(len(near)):
            begin[start + i] = near[i]
    return begin, bins.max()


@inner(error_model="numpy", fastmath=IN_ORDER)
def _add_tile(
    start: int,
    size: int,
    patch: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    lobe: Lobe,
    lattices: Lattices,
    table: NumbaTables,
    begin: Float32,
    rows: Float32,
    rest: Float32,
    sums: Float32,
    bound: Float32,
) -> None:
    """Add the tables of some patches to the windows of a tile's beams, and to their bounds."""
    bins = sums.shape[1]
    per_bin = table.per_bin
    places = rows.shape[1]
    span = rows.shape[3]
    width = span - WINDOW
    flat = rows.ravel()
    every = sums.ravel()
    count = NEIGHBORS + 1 if lobe.gain > 0 else 1
    tile = feet.bounds_m[start // BEAM_TILE : start // BEAM_TILE + 1]
    verdicts = judge(patch, patch + len(rows), surface, tile, optics, field)
    legs = scratch(size)
    base = np.zeros(NEIGHBORS + 1, np.int64)
    offset = np.empty(NEIGHBORS + 1, np.int32)
    weight = np.empty(NEIGHBORS + 1, np.float32)
    along_x = np.empty(4, np.float32)
    along_y = np.empty(4, np.float32)
    for j in range(len(rows)):
        s = patch + j
        if verdicts[j, 0] == DARK:
            continue
        fill(legs, s, surface, feet, start, size, verdicts[j, 0], optics, field, False)
        corner = lattices.corner[s]
        place_of = lattices.place[s]
        for i in range(size):
            if legs.weight[i] == 0:
                continue
            # d1 + d2 in sub-bins, rounded: whole bins move the window, the rest picks the shift.
            at = np.int32(
                (legs.length_m[i] + feet.length_m[start + i]) * optics.inverse_bin + np.float32(0.5)
            )
            ahead = int(begin[start + i]) - at // per_bin - table.first[s]
            beyond = min(max(ahead + bins, 0), table.width)
            shift = (at % per_bin) * span + WINDOW

            # First the diffuse part, which goes with A(p, s) of S2 alone.
            light = legs.weight[i] * surface.strength[s]
            weight[0] = light * lobe.diffuse
            base[0] = j * places * per_bin * span + shift
            later = weight[0] * rest[j, 0, beyond]
            if lobe.gain > 0:
                x, y = _on_plane(
                    feet.x_m[start + i] - surface.x_m[s],
                    feet.y_m[start + i] - surface.y_m[s],
                    surface.z_m[s],
                    lobe.step,
                )
                # Then the 4 x 4 nodes around the light's direction; weights may be negative, so the
                # bound takes their size.
                column = int(np.floor(x))
                row = int(np.floor(y))
                _weights(x - np.float32(column), along_x)
                _weights(y - np.float32(row), along_y)
                node = (column - 1 - corner[0]) * corner[3] + row - 1 - corner[1]
                for a in range(4):
                    for b in range(4):
                        k = 1 + 4 * a + b
                        place = LANES + place_of[node + a * corner[3] + b]
                        weight[k] = light * lobe.gain * along_x[a] * along_y[b]
                        base[k] = (j * places + place) * per_bin * span + shift
                        later += abs(weight[k]) * rest[j, place, beyond]
            bound[start + i] += later

            # Rows begin with WINDOW zeros and end before others: a window that overlaps a row's
            # bins reads zeros where it reaches beyond.
            for window in range(0, bins, WINDOW):
                if -WINDOW < ahead + window < width:
                    offset[:] = ahead + window
                    add_rows(
                        every, (start + i) * bins + window, flat, base, offset, weight, 0, 1, count
                    )


@numba.njit(cache=True, parallel=True)
def _add(
    patch: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    lobe: Lobe,
    lattices: Lattices,
    table: NumbaTables,
    begin: Float32,
    rows: Float32,
    rest: Float32,
    sums: Float32,
    bound: Float32,
) -> None:
    """Add the tables of some patches to all beams' windows, and to a bound on each's later bins."""
    beams = len(feet.x_m)
    # One thread adds all patches to its beams in their order: no sum depends on the threads.
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        _add_tile(
            start,
            min(BEAM_TILE, beams - start),
            patch,
            feet,
            surface,
            optics,
            field,
            lobe,
            lattices,
            table,
            begin,
            rows,
            rest,
            sums,
            bound,
        )


def _sums(
    numba_job: NumbaJob, feet: NumbaPoints, lobe: Lobe, *, first_only: bool
) -> tuple[Int64, Float32, Float32]:
    """Return the bin (n,) at which each beam's window begins, its sums (n, bins), and a bound (n,)
    on later bins.

    Raises SceneError where the tables would take more memory than is tried.
    """
    surface, groups, centers, optics, field = numba_job.sites
    per_bin = numba_job.job.accuracy.sub_bins
    relay = numba_job.relay_in(CHUNK)
    nothing = np.empty(0, np.float32)
    table = NumbaTables(numba_job.first, nothing, nothing[None], per_bin, numba_job.width)
    begin, bins = _begins(feet, groups, centers, optics, table)

    # No path of a patch begins before the window, so that its first bins hold all that the first
    # window can meet.
    windows = 1 if first_only else -(-bins // WINDOW)
    span = WINDOW + min(WINDOW + 8, table.width) if first_only else WINDOW + table.width
    lattices = _places(surface, feet, lobe, _corners(surface, feet, lobe))
    # The first vector is the diffuse part's, and the last may not be full.
    nodes = 2 * LANES + int(lattices.needed.max()) // LANES * LANES
    sums = np.zeros((len(begin), windows * WINDOW), np.float32)
    bound = np.zeros(len(begin), np.float32)
    patches = len(surface.x_m)
    block = max(TABLE_BYTES // (4 * per_bin * nodes * span), numba.get_num_threads())
    block = min(block, patches)
    check_tables(numba_job.job, block, nodes * (per_bin * span + table.width + 1))
    # A row is read up to a window beyond its end: into the next one's zeros, or those after the
    # last.
    flat = np.zeros(block * nodes * per_bin * span + WINDOW, np.float32)
    whole = flat[:-WINDOW].reshape(block, nodes, per_bin, span)
    rest = np.zeros((block, nodes, table.width + 1), np.float32)
    for patch in range(0, patches, block):
        rows = whole[: patches - patch]
        some = rest[: patches - patch]
        where = surface, relay, optics, field, lobe, lattices, table
        _rows(patch, *where, rows, some)
        places = feet, surface, optics, field, lobe, lattices, table
        _add(patch, *places, begin, rows, some, sums, bound)
    # Interpolation may fall below 0 by its error where there is no light.
    begin = begin[feet.place]
    sums = sums[feet.place]
    bound = bound[feet.place]
    return begin.astype(np.int64), np.maximum(sums, 0), bound


def _histograms(numba_job: NumbaJob, lobe: Lobe, which: Any = slice(None)) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for some of the job's beams."""
    job = numba_job.job
    share = np.zeros(len(job.laser_spot_m))
    share[which] = 1
    begin, sums, _ = _sums(numba_job, numba_job.feet(share), lobe, first_only=False)
    found = np.zeros((len(begin), job.bins), np.float32)
    at = begin[:, None] + np.arange(sums.shape[1])
    beam, k = np.nonzero((at >= 0) & (at < job.bins))
    found[beam, at[beam, k]] = sums[beam, k]
    return found


def _lobe(job: TransportJob) -> Lobe:
    """Return the lobe of a job, without gain for a Lambertian surface."""
    return lobe_of(job.brdf or phong(1.0, 0.0, 1.0), job.accuracy.scatter_error)


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the beams of a job with a
    BRDF.
    """
    numba_job = NumbaJob(job)
    found = _histograms(numba_job, _lobe(job))
    if job.more_bounces:
        # Light that met the object twice is taken as diffuse, as in the reference.
        found += numba_job.second_bounces()
    return found


def echoes(job: TransportJob) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `histograms`, bit for bit, from a
    part of its work.
    """
    if job.more_bounces:
        return strongest(histograms(job), job.bin_m)
    numba_job = NumbaJob(job)
    lobe = _lobe(job)
    # First the window that nearly always holds the strongest two. A later bin can win only where
    # the bound on it, with room for rounding, exceeds the runner-up: those beams get all bins.
    every = numba_job.feet(np.ones(len(job.laser_spot_m)))
    begin, sums, bound = _sums(numba_job, every, lobe, first_only=True)
    at = begin[:, None] + np.arange(WINDOW)
    found = strongest(np.where((at >= 0) & (at < job.bins), sums, 0), job.bin_m)
    found.path_m[:] = ((found.path_m / job.bin_m - 0.5).round() + begin + 0.5) * job.bin_m
    unsure = np.flatnonzero(bound * ROUNDED > found.runner_up)
    if unsure.size:
        rest = strongest(_histograms(numba_job, lobe, unsure), job.bin_m)
        found.peak[unsure] = rest.peak
        found.runner_up[unsure] = rest.runner_up
        found.path_m[unsure] = rest.path_m
    return found
