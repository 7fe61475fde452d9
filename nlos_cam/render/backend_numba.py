"""Fast backend for the CPU (numba, float32): S2 factorized at the object's patches.

weight(p, s, q) = A(p, s) B(s, q) and length = (d1 + d2)(p, s) + (d3 + d4)(s, q) for beam p, patch s, relay cell q. So
each patch gets one table of B over d3 + d4, counted in sub-bins, and each beam adds the table, shifted by d1 + d2 to
the nearest sub-bin: n s + s q terms in place of n s q. The sums of sub-bins to bins are made in advance for each shift
within a bin, so that a beam adds one row of a table per patch. Neither rounding is biased: a path lies anywhere within
its sub-bin, and rounding to the nearest shift puts a bin's edge in the middle of a sub-bin.

numba's cache depends on this file alone: after a change of a kernel that is imported here, delete __pycache__.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int32
from numpy.typing import NDArray

from nlos_cam.frames import inner, int64
from nlos_cam.render.brdf_table import nodes, scattering
from nlos_cam.render.echoes import MultiBounce, strongest, strongest_between
from nlos_cam.render.interreflection import add_interreflection
from nlos_cam.render.job import TransportJob
from nlos_cam.render.legs import (
    FAST,
    WINDOW,
    NumbaLegs,
    NumbaOptics,
    NumbaPoints,
    NumbaSurface,
    add_rows,
    geometry,
    scratch,
    shade,
)
from nlos_cam.render.visibility import HeightField, horizon_table

LANES = 16
"""Bins by which the rows of tables are padded: whole widest vectors."""
BEAM_TILE = 64
"""Beams of a thread that go together: their windows of bins and their legs to some patches fit in the first cache."""
PATCH_BLOCK = 16
"""Patches whose legs are computed before their rows are added."""


class NumbaTables(NamedTuple):
    """Tables of the patches (n): B over d3 + d4 in bins, for each shift within a bin."""

    first: Int32
    """(n,); bin at which a patch's rows start."""
    rows: Float32
    """Flat; n * per_bin rows of WINDOW zeros and `width` bins, then WINDOW zeros: a window reads beyond both ends."""
    rest: Float32
    """(n, width + 1); largest value of any shift from a bin of the row on."""
    per_bin: int
    width: int


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def returns(
    legs: NumbaLegs, s: int, surface: NumbaSurface, relay: NumbaPoints, optics: NumbaOptics, field: HeightField
) -> np.float32:
    """Fill in B(s, q) of S2 for one patch with d3 + d4 in sub-bins as the length, and return the shortest."""
    cells = len(relay.x_m)
    # Wall to lidar in the points' weights, patch to wall in the legs.
    geometry(legs, s, surface, relay, 0, cells, optics, field, True)
    if optics.sectors:
        shade(legs, s, surface, relay, int64(0), cells, field)
    shortest = np.float32(np.inf)
    for q in range(cells):
        legs.length_m[q] = (legs.length_m[q] + relay.length_m[q]) * optics.inverse_bin
        shortest = min(shortest, legs.length_m[q])
    return shortest


@inner(error_model="numpy", fastmath=FAST)
def _count(
    s: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    factor: Float32,
    per_bin: int,
    histogram: Float32,
) -> int:
    """Count B over d3 + d4 of one patch in sub-bins, and return the bin at which they start."""
    cells = len(relay.x_m)
    legs = scratch(cells)
    # The table starts at the first bin that any path of this patch falls into: its rows then need the spread only.
    first = int(returns(legs, s, surface, relay, optics, field)) // per_bin
    if len(factor):
        for q in range(cells):
            legs.weight[q] *= factor[s, q]
    start = np.float32(first * per_bin)
    for q in range(cells):
        legs.sector[q] = np.int32(legs.length_m[q] - start)  # not negative: first is this patch's own floor
    for q in range(cells):
        histogram[legs.sector[q]] += legs.weight[q]
    return first


@numba.njit(cache=True, parallel=True)
def sub_bins(
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    factor: Float32,
    per_bin: int,
    width: int,
) -> tuple[Int32, Float32]:
    """Return histograms (n, width * per_bin) of B over d3 + d4 in sub-bins, and the bin (n,) at which each starts."""
    patches = len(surface.x_m)
    first, histogram = np.zeros(patches, np.int32), np.zeros((patches, width * per_bin), np.float32)
    for s in numba.prange(patches):
        first[s] = _count(int64(s), surface, relay, optics, field, factor, per_bin, histogram[s])
    return first, histogram


@numba.njit(cache=True, parallel=True)
def tables(first: Int32, histogram: Float32, per_bin: int) -> NumbaTables:
    """Return sub-bin histograms (n, width * per_bin) as sums to bins, for each shift."""
    patches, width = len(histogram), histogram.shape[1] // per_bin
    rows = np.zeros((patches * per_bin + 1, WINDOW + width), np.float32)
    rest = np.zeros((patches, width + 1), np.float32)
    for s in numba.prange(patches):
        below = np.zeros(width * per_bin + 1)
        for k in range(width * per_bin):
            below[k + 1] = below[k] + histogram[s, k]
        # Bin i of the table for a shift is a difference of running sums, from sub-bin i per_bin - shift to
        # (i + 1) per_bin - shift. The sums are float64, so that the difference of large sums keeps the small bins.
        for shift in range(per_bin):
            for i in range(width):
                value = np.float32(below[(i + 1) * per_bin - shift] - below[max(i * per_bin - shift, 0)])
                rows[s * per_bin + shift, WINDOW + i] = value
                rest[s, i] = max(rest[s, i], value)
        for i in range(width - 1, -1, -1):
            rest[s, i] = max(rest[s, i], rest[s, i + 1])
    return NumbaTables(first, rows.ravel(), rest, per_bin, width)


@inner(error_model="numpy", fastmath=FAST)
def ends(
    start: int, count: int, feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics, table: NumbaTables
) -> tuple[Float32, int]:
    """Return a bin (count,) before every path of each beam, and the bins from there to the last path of any beam."""
    near, far = np.full(count, np.float32(np.inf)), np.zeros(count, np.float32)
    at_x, at_y = feet.x_m[start : start + count], feet.y_m[start : start + count]
    for s in range(len(table.first)):
        x, y, z = surface.x_m[s], surface.y_m[s], surface.z_m[s]
        begins = np.float32(table.first[s] * table.per_bin)
        for i in range(count):
            dx, dy = at_x[i] - x, at_y[i] - y
            length = np.sqrt(dx * dx + dy * dy + z * z) * optics.inverse_bin + begins
            near[i], far[i] = min(near[i], length), max(far[i], length)
    spread, whole = 0, np.float32(1 / table.per_bin)
    for i in range(count):
        spread = max(spread, int((far[i] - near[i]) * whole))
        # A beam's first path is d1 + min (d2 + d3 + d4) over the patches; one bin less covers rounding.
        near[i] = np.floor((near[i] + feet.length_m[start + i] * optics.inverse_bin) * whole) - np.float32(1)
    return near, spread + table.width + 3


@inner(error_model="numpy", fastmath=FAST)
def _place(
    legs: NumbaLegs, length_m: Float32, begin: Float32, strength: np.float32, first: np.float32, table: NumbaTables,
    inverse_bin: np.float32, weight: Float32, row: Float32, ahead: Float32,
) -> tuple[np.float32, np.float32]:  # fmt: skip
    """Fill in each leg's weight, row of the patch's table, and bin of the row at which the beam's window begins.

    Return the sum of the weights and the smallest of those bins. All numbers are whole, and exact in float32.
    """
    total, least = np.float32(0), np.float32(np.inf)
    per_bin, whole, stride = np.float32(table.per_bin), np.float32(1 / table.per_bin), np.float32(WINDOW + table.width)
    for i in range(len(begin)):
        shift = np.floor((legs.length_m[i] + length_m[i]) * inverse_bin + np.float32(0.5))
        bins = np.floor(shift * whole)
        weight[i] = legs.weight[i] * strength
        row[i] = (shift - bins * per_bin) * stride
        ahead[i] = begin[i] - bins - first
        total += weight[i]
        least = min(least, ahead[i])
    return total, least


@inner(error_model="numpy", fastmath=FAST)
def _add_tile(
    start: int, count: int, feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics, field: HeightField,
    table: NumbaTables, begin: Float32, sums: Float32,
) -> Float32:  # fmt: skip
    """Add every patch to the windows (count, windows * WINDOW) of some beams, from a bin (count,) of each beam on.

    Return a bound (count,) on every bin beyond: at most each patch's largest value from there on, times its weight.
    """
    # Legs of some patches first, then the rows of each beam: rows and windows stay in the first cache
    legs, bound = scratch(count), np.zeros(count, np.float32)
    weights, offsets = np.empty(PATCH_BLOCK * count, np.float32), np.empty(PATCH_BLOCK * count, np.int32)
    weight, offset = weights.reshape(PATCH_BLOCK, count), offsets.reshape(PATCH_BLOCK, count)
    row, ahead = np.empty((PATCH_BLOCK, count), np.float32), np.empty((PATCH_BLOCK, count), np.float32)
    every, base, used = sums.ravel(), np.empty(PATCH_BLOCK, np.int64), 0
    bins, width, length_m = sums.shape[1], np.float32(table.width), feet.length_m[start : start + count]
    for s in range(len(table.first)):
        geometry(legs, s, surface, feet, start, count, optics, field, False)
        if optics.sectors:
            shade(legs, s, surface, feet, start, count, field)
        strength, first = surface.strength[s], np.float32(table.first[s])
        total, least = _place(
            legs, length_m, begin, strength, first, table, optics.inverse_bin, weight[used], row[used], ahead[used]
        )
        if total > 0:
            # h(k) = sum_s A(p, s) T_s(k - at_s): beyond the window each T_s is at most its largest value from there.
            largest = table.rest[s, min(max(int(least) + bins, 0), table.width)]
            for i in range(count):
                bound[i] += weight[used, i] * largest
            base[used] = s * table.per_bin * (WINDOW + table.width) + WINDOW
            used += 1
        if used < PATCH_BLOCK and s + 1 < len(table.first):
            continue
        for window in range(0, bins, WINDOW):
            for j in range(used):
                for i in range(count):
                    at = min(max(ahead[j, i] + np.float32(window), np.float32(-WINDOW)), width)
                    offset[j, i] = np.int32(row[j, i] + at)
            for i in range(count):
                add_rows(every, i * bins + window, table.rows, base, offsets, weights, i, count, used)
        used = 0
    return bound


@inner()
def _sum_tile(
    start: int, feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics, field: HeightField, table: NumbaTables,
    most: int,
) -> tuple[Float32, Float32, Float32]:  # fmt: skip
    """Return the first bin (count,) of a tile's beams, their sums from there on over `most` bins or all, and a bound.

    The bound (count,) is on every bin beyond the sums.
    """
    count = min(BEAM_TILE, len(feet.x_m) - start)
    begin, span = ends(start, count, feet, surface, optics, table)
    sums = np.zeros((count, (min(span, most) + WINDOW - 1) // WINDOW * WINDOW), np.float32)
    return begin, sums, _add_tile(start, count, feet, surface, optics, field, table, begin, sums)


@numba.njit(cache=True, parallel=True)
def shift_and_add(
    feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics, field: HeightField, table: NumbaTables, bins: int
) -> Float32:
    """Return histograms (n, bins) of beams: the sum of every patch's table, times A, shifted by d1 + d2."""
    beams = len(feet.x_m)
    histogram = np.zeros((beams, bins), np.float32)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        begin, sums, _ = _sum_tile(start, feet, surface, optics, field, table, bins)
        for i in range(len(begin)):
            first = int(begin[i])
            for k in range(max(-first, 0), min(sums.shape[1], bins - first)):
                histogram[start + i, first + k] = sums[i, k]
    return histogram


@numba.njit(cache=True, parallel=True)
def _strongest_in_window(
    feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics, field: HeightField, table: NumbaTables, bins: int
) -> tuple[NDArray[np.int64], Float32, Float32, NDArray[np.bool_]]:
    """Return bin, value and runner-up (n,) of the strongest of each beam's first WINDOW bins, and if no other can win.

    Light comes back strongest from the shortest paths, so the first window nearly always holds both bins.
    """
    beams = len(feet.x_m)
    winner, peak, second = np.zeros(beams, np.int64), np.zeros(beams, np.float32), np.zeros(beams, np.float32)
    sure = np.zeros(beams, np.bool_)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        begin, sums, bound = _sum_tile(start, feet, surface, optics, field, table, int64(WINDOW))
        for i in range(len(begin)):
            first = int(begin[i])
            best = strongest_between(sums[i], max(-first, 0), min(WINDOW, bins - first))
            winner[start + i], peak[start + i], second[start + i] = best[0] + first, best[1], best[2]
            sure[start + i] = bound[i] * ROUNDED <= best[2]
    return winner, peak, second, sure


ROUNDED = np.float32(1.001)
"""Factor on a bound, more than the rounding of its sum."""


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the job's beams.

    The result does not depend on the number of threads: one thread sums each histogram, patches in order.
    """
    numba_job = NumbaJob(job)
    if job.brdf is None:
        return numba_job.histograms(np.empty((0, 0), np.float32), np.ones(len(job.laser_spot_m)))
    from nlos_cam.render import glossy  # imports this file

    if not job.more_bounces and (functions := glossy.glossy_basis(job, job.brdf)) is not None:
        return glossy.histograms(numba_job, functions)
    total = np.zeros((len(job.laser_spot_m), job.bins), np.float32)
    for foot, share in nodes(job, job.brdf):
        factor = scattering(job.brdf)(foot, job.patches.point_m, job.patches.normal, job.relay.x_m, job.relay.y_m)
        total += numba_job.histograms(factor.astype(np.float32), share)
    return total


def echoes(job: TransportJob) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `histograms`, bit for bit, from a part of its work.

    Each beam sums its first bins alone, with a bound on all others; the few beams that the bound does not decide sum
    the rest too. A BRDF without few eigenfunctions needs whole histograms.
    """
    numba_job = NumbaJob(job)
    if job.brdf is not None:
        from nlos_cam.render import glossy

        functions = None if job.more_bounces else glossy.glossy_basis(job, job.brdf)
        return glossy.echoes(numba_job, functions) if functions else strongest(histograms(job), job.bin_m)
    every = numba_job.feet(np.ones(len(job.laser_spot_m)))
    table = numba_job.tables(np.empty((0, 0), np.float32))
    winner, peak, second, sure = _strongest_in_window(every, *numba_job.sites, table, job.bins)
    path = np.where(peak > 0, (winner + 0.5) * job.bin_m, np.nan).astype(np.float32)
    found = MultiBounce(peak, second, path)
    if (unsure := np.flatnonzero(~sure)).size:
        some = numba_job.feet((~sure).astype(np.float64))
        rest = strongest(shift_and_add(some, *numba_job.sites, table, job.bins), job.bin_m)
        found.peak[unsure], found.runner_up[unsure], found.path_m[unsure] = rest.peak, rest.runner_up, rest.path_m
    return found


class NumbaJob:
    """Job in float32, with everything that does not depend on the BRDF computed once."""

    def __init__(self, job: TransportJob) -> None:
        patches, relay = job.patches, job.relay
        self.job, accuracy = job, job.accuracy
        geometry = *_columns(patches.point_m), *_columns(patches.normal), _single(job.soft_patch_m2)
        low, high, walk = horizons(job)
        shaded = high.max(1) * reach_cells(job) > patches.point_m[:, 2] if job.field.shades else np.empty(0, np.bool_)
        sites = patches.row, patches.column, low, high, walk, shaded
        self.surface = NumbaSurface(*geometry, _single(job.strength), *sites)
        columns = relay.x_m, relay.y_m, relay.length_m, job.relay_weight
        self.relay = _points(columns, job.soft_wall_m2)
        edge_x, edge_z = job.edge_m
        edge = np.float32(edge_x), np.float32(edge_z), np.float32(job.near_m**2)
        sectors = accuracy.sectors if job.field.shades else 0
        self.optics = NumbaOptics(*edge, job.lambertian, np.float32(accuracy.sub_bins / job.bin_m), sectors)
        self.width = table_width(job)

    @property
    def sites(self) -> tuple[NumbaSurface, NumbaOptics, HeightField]:
        """Arguments of the kernels that do not depend on beams and tables."""
        return self.surface, self.optics, self.job.field

    def feet(self, share: Float64) -> NumbaPoints:
        """Return the beams with a weight (n,) above 0."""
        some, job = np.flatnonzero(share), self.job
        x, y, _ = job.laser_spot_m[some].T
        return _points((x, y, job.length_m[some], job.beam_weight[some] * share[some]), 0.0)

    def tables(self, factor: Float32) -> NumbaTables:
        """Return the patches' tables, with a BRDF's factor (n, m) or an empty one."""
        job, per_bin = self.job, self.job.accuracy.sub_bins
        first, fine = sub_bins(self.surface, self.relay, self.optics, job.field, factor, per_bin, self.width)
        return tables(first, add_interreflection(job, first, fine) if job.more_bounces else fine, per_bin)

    def histograms(self, factor: Float32, share: Float64) -> Float32:
        """Return histograms (n, bins) of the beams, each with a weight (n,)."""
        bins = self.job.bins
        found = shift_and_add(self.feet(share), *self.sites, self.tables(factor), bins)
        if len(found) == len(share):
            return found
        histogram = np.zeros((len(share), bins), np.float32)
        histogram[share > 0] = found
        return histogram


def _single(column: Float64) -> Float32:
    return np.ascontiguousarray(column, np.float32)


def _points(columns: tuple[Float64, Float64, Float64, Float64], soft_m2: float) -> NumbaPoints:
    x, y, length, weight = (_single(column) for column in columns)
    return NumbaPoints(x, y, length, weight, np.float32(soft_m2))


def _columns(points: Float64) -> tuple[Float32, Float32, Float32]:
    return _single(points[:, 0]), _single(points[:, 1]), _single(points[:, 2])


def horizons(job: TransportJob) -> tuple[Float32, Float32, NDArray[np.uint8]]:
    """Return the `horizon_table` of the job's patches at its accuracy; empty if nothing shades."""
    patches, field, accuracy = job.patches, job.field, job.accuracy
    if not field.shades:
        return np.empty((0, 0), np.float32), np.empty((0, 0), np.float32), np.empty((0, 0, 2), np.uint8)
    where = patches.row, patches.column, patches.point_m[:, 2].copy(), reach_cells(job)
    return horizon_table(field, *where, accuracy.sectors)


def reach_cells(job: TransportJob) -> Float64:
    """Return the longest leg (n,) from each patch along an axis to a beam's spot or a relay cell, in cells."""
    point, field = job.patches.point_m, job.field
    x = np.concatenate([job.laser_spot_m[:, 0], job.relay.x_m])
    y = np.concatenate([job.laser_spot_m[:, 1], job.relay.y_m])
    across = np.maximum(x.max() - point[:, 0], point[:, 0] - x.min()) / field.pitch_x_m
    along = np.maximum(y.max() - point[:, 1], point[:, 1] - y.min()) / field.pitch_y_m
    return np.maximum(across, along)


def table_width(job: TransportJob) -> int:
    """Return the bins from the shortest to the longest d3 + d4 of any patch, in whole vectors.

    d3 + d4 is convex over the wall: longest at a corner of the relay, and never shorter than the straight line to the
    mirror image of the lidar behind the wall.
    """
    x, y, z = job.patches.point_m.T
    relay, lidar = job.relay, job.lidar_m
    # A convex function is largest at a corner of a rectangle; the shortest way is by the mirror image (Heron).
    longest = np.zeros_like(x)
    for corner_x in (relay.x_m.min(), relay.x_m.max()):
        for corner_y in (relay.y_m.min(), relay.y_m.max()):
            d3 = np.sqrt((x - corner_x) ** 2 + (y - corner_y) ** 2 + z**2)
            longest = np.maximum(longest, d3 + np.linalg.norm([corner_x - lidar[0], corner_y - lidar[1], lidar[2]]))
    shortest = np.sqrt((x - lidar[0]) ** 2 + (y - lidar[1]) ** 2 + (z + lidar[2]) ** 2)
    bins = int((longest - shortest).max() / job.bin_m) + 3
    return (bins + LANES - 1) // LANES * LANES
