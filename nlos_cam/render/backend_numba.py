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

from nlos_cam.render.brdf_table import nodes, scattering
from nlos_cam.render.interreflection import add_interreflection
from nlos_cam.render.job import TransportJob
from nlos_cam.render.visibility import HeightField, blocked, horizon_table

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


@numba.njit(cache=True)
def shade(
    legs: NumbaLegs, s: int, surface: NumbaSurface, points: NumbaPoints, start: int, count: int, field: HeightField
) -> None:
    """Set the weight of legs that the object blocks to 0."""
    z = surface.z_m[s]
    for i in range(count):
        # Free above the upper bound of the horizon, blocked below the lower one; in between the leg is walked.
        if z >= legs.major[i] * surface.high[s, legs.sector[i]]:
            continue
        if z >= legs.major[i] * surface.low[s, legs.sector[i]]:
            u = (points.x_m[start + i] - surface.x_m[s]) / field.pitch_x_m
            v = (surface.y_m[s] - points.y_m[start + i]) / field.pitch_y_m
            if legs.weight[i] == 0 or not blocked(field, surface.row[s], surface.column[s], z, u, v):
                continue
        legs.weight[i] = 0


@numba.njit(cache=True, inline="always")
def scratch(count: int) -> NumbaLegs:
    return NumbaLegs(
        np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.int32), np.empty(count, np.float32)
    )


LANES = 16
"""Bins by which the rows of tables are padded: whole widest vectors."""
BEAM_TILE = 64
"""Beams per thread whose histograms stay in the cache during the loop over patches."""


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
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
    geometry(legs, s, surface, relay, 0, cells, optics, field, True)
    if optics.sectors:
        shade(legs, s, surface, relay, 0, cells, field)
    if len(factor):
        for q in range(cells):
            legs.weight[q] *= factor[s, q]
    # The table starts at the first bin that any path of this patch falls into: its rows then need the spread only.
    shortest = np.float32(np.inf)
    for q in range(cells):
        legs.length_m[q] = (legs.length_m[q] + relay.length_m[q]) * optics.inverse_bin
        shortest = min(shortest, legs.length_m[q])
    first = int(shortest) // per_bin
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
        first[s] = _count(s, surface, relay, optics, field, factor, per_bin, histogram[s])
    return first, histogram


@numba.njit(cache=True, parallel=True)
def tables(histogram: Float32, per_bin: int) -> Float32:
    """Return sub-bin histograms (n, width * per_bin) as sums to bins (n, per_bin, width), for each shift."""
    patches, width = len(histogram), histogram.shape[1] // per_bin
    table = np.zeros((patches, per_bin, width), np.float32)
    for s in numba.prange(patches):
        below = np.zeros(width * per_bin + 1)
        for k in range(width * per_bin):
            below[k + 1] = below[k] + histogram[s, k]
        # Bin i of the table for a shift is a difference of running sums, from sub-bin i per_bin - shift to
        # (i + 1) per_bin - shift. The sums are float64, so that the difference of large sums keeps the small bins.
        for shift in range(per_bin):
            for i in range(width):
                table[s, shift, i] = below[(i + 1) * per_bin - shift] - below[max(i * per_bin - shift, 0)]
    return table


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_tile(
    start: int,
    count: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    first: Int32,
    table: Float32,
    bins: int,
    histogram: Float32,
) -> None:
    """Add every patch to the histograms (count, bins) of some beams."""
    _, per_bin, width = table.shape
    log = int(np.log2(per_bin) + 0.5)
    legs = scratch(count)
    for s in range(len(table)):
        geometry(legs, s, surface, feet, start, count, optics, field, False)
        if optics.sectors:
            shade(legs, s, surface, feet, start, count, field)
        for i in range(count):
            legs.sector[i] = np.int32(
                (legs.length_m[i] + feet.length_m[start + i]) * optics.inverse_bin + np.float32(0.5)
            )
        for i in range(count):
            # per_bin is a power of two: a shift splits into whole bins (>> log) and the row of the table (& mask).
            at = (legs.sector[i] >> log) + first[s]
            if legs.weight[i] == 0 or at >= bins:
                continue
            weight = legs.weight[i] * surface.strength[s]
            row, out = table[s, legs.sector[i] & (per_bin - 1)], histogram[i, at : at + width]
            for k in range(width):
                out[k] += weight * row[k]


@numba.njit(cache=True, parallel=True)
def shift_and_add(
    feet: NumbaPoints,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    first: Int32,
    table: Float32,
    bins: int,
) -> Float32:
    """Return histograms (n, bins) of beams: the sum of every patch's table, times A, shifted by d1 + d2."""
    beams = len(feet.x_m)
    histogram = np.zeros((beams, (bins + table.shape[2] + LANES) // LANES * LANES), np.float32)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        end = min(start + BEAM_TILE, beams)
        _add_tile(start, end - start, feet, surface, optics, field, first, table, bins, histogram[start:end])
    return histogram


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the job's beams.

    The result does not depend on the number of threads: one thread sums each histogram, patches in order.
    """
    numba_job = _NumbaJob(job)
    if job.brdf is None:
        return numba_job.histograms(np.empty((0, 0), np.float32), np.ones(len(job.laser_spot_m)))
    total = np.zeros((len(job.laser_spot_m), job.bins), np.float32)
    for foot, share in nodes(job, job.brdf):
        factor = scattering(job.brdf)(foot, job.patches.point_m, job.patches.normal, job.relay.x_m, job.relay.y_m)
        total += numba_job.histograms(factor.astype(np.float32), share)
    return total


class _NumbaJob:
    """Job in float32, with everything that does not depend on the BRDF computed once."""

    def __init__(self, job: TransportJob) -> None:
        patches, relay = job.patches, job.relay
        self.job, accuracy = job, job.accuracy
        geometry = *_columns(patches.point_m), *_columns(patches.normal), _single(job.soft_patch_m2)
        sites = patches.row, patches.column, *horizons(job)
        self.surface = NumbaSurface(*geometry, _single(job.strength), *sites)
        columns = relay.x_m, relay.y_m, relay.length_m, job.relay_weight
        self.relay = _points(columns, job.soft_wall_m2)
        edge_x, edge_z = job.edge_m
        edge = np.float32(edge_x), np.float32(edge_z), np.float32(job.near_m**2)
        sectors = accuracy.sectors if job.field.shades else 0
        self.optics = NumbaOptics(*edge, job.lambertian, np.float32(accuracy.sub_bins / job.bin_m), sectors)
        self.width = table_width(job)

    def histograms(self, factor: Float32, share: Float64) -> Float32:
        """Return histograms (n, bins) of the beams, each with a weight (n,)."""
        job = self.job
        some = np.flatnonzero(share)
        x, y, _ = job.laser_spot_m[some].T
        feet = _points((x, y, job.length_m[some], job.beam_weight[some] * share[some]), 0.0)
        first, fine = sub_bins(
            self.surface, self.relay, self.optics, job.field, factor, job.accuracy.sub_bins, self.width
        )
        if job.more_bounces:
            fine = add_interreflection(job, first, fine)
        table = tables(fine, job.accuracy.sub_bins)
        found = shift_and_add(feet, self.surface, self.optics, job.field, first, table, job.bins)
        if len(some) == len(share):
            return found[:, : job.bins]
        histogram = np.zeros((len(share), job.bins), np.float32)
        histogram[some] = found[:, : job.bins]
        return histogram


def _single(column: Float64) -> Float32:
    return np.ascontiguousarray(column, np.float32)


def _points(columns: tuple[Float64, Float64, Float64, Float64], soft_m2: float) -> NumbaPoints:
    x, y, length, weight = (_single(column) for column in columns)
    return NumbaPoints(x, y, length, weight, np.float32(soft_m2))


def _columns(points: Float64) -> tuple[Float32, Float32, Float32]:
    return _single(points[:, 0]), _single(points[:, 1]), _single(points[:, 2])


def horizons(job: TransportJob) -> tuple[Float32, Float32]:
    """Return the horizon tables (n, FACES * sectors), low and high, for the job's accuracy; empty if nothing shades."""
    patches, field, accuracy = job.patches, job.field, job.accuracy
    if not field.shades:
        return np.empty((0, 0), np.float32), np.empty((0, 0), np.float32)
    x = np.concatenate([job.laser_spot_m[:, 0], job.relay.x_m])
    y = np.concatenate([job.laser_spot_m[:, 1], job.relay.y_m])
    across = np.maximum(x.max() - patches.point_m[:, 0], patches.point_m[:, 0] - x.min()) / field.pitch_x_m
    along = np.maximum(y.max() - patches.point_m[:, 1], patches.point_m[:, 1] - y.min()) / field.pitch_y_m
    where = patches.row, patches.column, patches.point_m[:, 2].copy(), np.maximum(across, along)
    return horizon_table(field, *where, accuracy.sectors)


def table_width(job: TransportJob) -> int:
    """Return the bins from the shortest to the longest d3 + d4 of any patch, in whole vectors.

    d3 + d4 is convex over the wall: longest at a corner of the relay, and never shorter than the straight line to the
    mirror image of the lidar behind the wall.
    """
    x, y, z = job.patches.point_m.T
    relay, lidar = job.relay, job.lidar_m
    longest = np.zeros_like(x)
    for corner_x in (relay.x_m.min(), relay.x_m.max()):
        for corner_y in (relay.y_m.min(), relay.y_m.max()):
            d3 = np.sqrt((x - corner_x) ** 2 + (y - corner_y) ** 2 + z**2)
            longest = np.maximum(longest, d3 + np.linalg.norm([corner_x - lidar[0], corner_y - lidar[1], lidar[2]]))
    shortest = np.sqrt((x - lidar[0]) ** 2 + (y - lidar[1]) ** 2 + (z + lidar[2]) ** 2)
    bins = int((longest - shortest).max() / job.bin_m) + 3
    return (bins + LANES - 1) // LANES * LANES
