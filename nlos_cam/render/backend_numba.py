"""Fast backend for the CPU (numba, float32): S2 factorized at the object's patches.

weight(p, s, q) = A(p, s) B(s, q) and length = (d1 + d2)(p, s) + (d3 + d4)(s, q) for beam p, patch
s, relay cell q. So each patch gets one table of B over d3 + d4, counted in sub-bins, and each beam
adds the table, shifted by d1 + d2 to the nearest sub-bin: n s + s q terms in place of n s q. The
sums of sub-bins to bins are made in advance for each shift within a bin, so that a beam adds one
row of a table per patch (`beam_sums`). Neither rounding is biased: a path lies anywhere within its
sub-bin, and rounding to the nearest shift puts a bin's edge in the middle of a sub-bin.
"""

from functools import lru_cache
from math import ceil, sqrt

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int32
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import inner, int64
from nlos_cam.render.beam_sums import (
    NumbaScene,
    NumbaTables,
    groups_of,
    shift_and_add,
    strongest_in_window,
)
from nlos_cam.render.echoes import MultiBounce, strongest
from nlos_cam.render.interreflection import add_interreflection
from nlos_cam.render.job import TransportJob
from nlos_cam.render.legs import (
    BEAM_TILE,
    DARK,
    FAST,
    RELAY_TILE,
    WINDOW,
    NumbaLegs,
    NumbaOptics,
    NumbaPoints,
    NumbaSurface,
    fill,
    judge,
    scratch,
)
from nlos_cam.render.visibility import HeightField, horizon_table

LANES = 16
"""Bins by which the rows of tables are padded: whole widest vectors."""
COUNTERS = 4
"""Histograms of a patch that are counted at once, by turns."""
MAX_TABLE_BYTES = 8 << 30
"""Largest tables that are tried at all."""


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def returns(
    verdict: int,
    legs: NumbaLegs,
    s: int,
    start: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
) -> int:
    """Fill in B(s, q) of S2 for a patch and the cells of a tile, with d3 + d4 in sub-bins as the
    length.

    Return the number of legs, 0 for a tile without light.
    """
    count = 0 if verdict == DARK else min(relay.tile, len(relay.x_m) - start)
    # Wall to lidar in the points' weights, patch to wall in the legs.
    if count:
        fill(legs, s, surface, relay, start, count, verdict, optics, field, True)
    for i in range(count):
        legs.length_m[i] = (legs.length_m[i] + relay.length_m[start + i]) * optics.inverse_bin
    return count


@inner(error_model="numpy", fastmath=FAST)
def _count(
    s: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    start: np.float32,
    histogram: Float32,
) -> None:
    """Count B over d3 + d4 of one patch in sub-bins, from the sub-bin `start` on."""
    # Neighboring cells often share a sub-bin, and each sum there would wait for the one before: so
    # neighbors count in histograms of their own.
    lanes = np.zeros((COUNTERS, len(histogram)), np.float32)
    legs = scratch(relay.tile)
    verdicts = judge(s, s + 1, surface, relay.bounds_m, optics, field)[0]
    for tile in range(len(verdicts)):
        count = returns(verdicts[tile], legs, s, tile * relay.tile, surface, relay, optics, field)
        for i in range(count):
            legs.sector[i] = np.int32(legs.length_m[i] - start)
        for i in range(count):
            lanes[i % COUNTERS, legs.sector[i]] += legs.weight[i]
    for lane in range(COUNTERS):
        histogram += lanes[lane]


@numba.njit(cache=True, parallel=True)
def sub_bins(
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    first: Int32,
    per_bin: int,
    width: int,
) -> Float32:
    """Return histograms (n, width * per_bin) of B over d3 + d4 in sub-bins, each from a bin (n,)
    on.
    """
    histogram = np.zeros((len(first), width * per_bin), np.float32)
    for s in numba.prange(len(first)):
        _count(
            int64(s),
            surface,
            relay,
            optics,
            field,
            np.float32(first[s] * per_bin),
            histogram[s],
        )
    return histogram


@numba.njit(cache=True, parallel=True)
def tables(first: Int32, histogram: Float32, per_bin: int) -> NumbaTables:
    """Return sub-bin histograms (n, width * per_bin) as sums to bins, for each shift."""
    patches = len(histogram)
    width = histogram.shape[1] // per_bin
    rows = np.zeros((patches * per_bin + 1, WINDOW + width), np.float32)
    rest = np.zeros((patches, width + 1), np.float32)
    for s in numba.prange(patches):
        # Running sums: below[k] is the light before sub-bin k.
        below = np.zeros(width * per_bin + 1)
        for k in range(width * per_bin):
            below[k + 1] = below[k] + histogram[s, k]
        # Bin i of the table for a shift is a difference of running sums, from sub-bin i per_bin -
        # shift to (i + 1) per_bin - shift. The sums are float64, so that the difference of large
        # sums keeps the small bins.
        for shift in range(per_bin):
            for i in range(width):
                value = np.float32(
                    below[(i + 1) * per_bin - shift] - below[max(i * per_bin - shift, 0)]
                )
                rows[s * per_bin + shift, WINDOW + i] = value
                rest[s, i] = max(rest[s, i], value)
        # The largest value from a bin on is the larger of its own and of those after it.
        for i in range(width - 1, -1, -1):
            rest[s, i] = max(rest[s, i], rest[s, i + 1])
    return NumbaTables(first, rows.ravel(), rest, per_bin, width)


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the beams of a job without a
    BRDF.

    The result does not depend on the number of threads: one thread sums each histogram, patches in
    order.
    """
    return NumbaJob(job).histograms()


def echoes(job: TransportJob) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `histograms`, bit for bit, from a
    part of its work.

    Each beam sums its first bins alone, with a bound on all others; the few beams that the bound
    does not decide sum the rest too.
    """
    numba_job = NumbaJob(job)
    every = numba_job.feet(np.ones(len(job.laser_spot_m)))
    table = numba_job.tables()
    winner, peak, second, sure = strongest_in_window(every, *numba_job.sites, table, job.bins)
    path = np.where(peak > 0, (winner + 0.5) * job.bin_m, np.nan).astype(np.float32)
    found = MultiBounce(peak, second, path)

    unsure = np.flatnonzero(~sure)
    if unsure.size:
        # By whole tiles, as `histograms` sums them: the same joins, and so the same bits.
        tiles, which = np.unique(every.place[unsure] // BEAM_TILE, return_inverse=True)
        whole = shift_and_add(tiles.astype(np.int64), every, *numba_job.sites, table, job.bins)
        rest = strongest(whole[which * BEAM_TILE + every.place[unsure] % BEAM_TILE], job.bin_m)
        found.peak[unsure] = rest.peak
        found.runner_up[unsure] = rest.runner_up
        found.path_m[unsure] = rest.path_m
    return found


class NumbaJob:
    """Job in float32, with everything that does not depend on the BRDF computed once."""

    def __init__(self, job: TransportJob, *, tiled: bool = True) -> None:
        patches = job.patches
        self.job = job
        accuracy = job.accuracy
        self._tiled = tiled
        geometry = *_columns(patches.point_m), *_columns(patches.normal), _single(job.soft_patch_m2)
        # A patch is shaded if it lies below its highest horizon on some leg: z < u h (see
        # `visibility`) for the longest u and the largest h.
        low, high, walk = horizons(job)
        highest = high.max(1, initial=0)
        shaded = (
            highest * reach_cells(job) > patches.point_m[:, 2]
            if job.field.shades
            else np.empty(0, np.bool_)
        )
        sites = patches.row, patches.column, low, high, walk, highest, shaded
        self.surface = NumbaSurface(*geometry, _single(job.strength), *sites)
        self.relay = self.relay_in(RELAY_TILE)
        edge_x, edge_z = job.edge_m
        edge = np.float32(edge_x), np.float32(edge_z), np.float32(job.near_m**2)
        sectors = accuracy.sectors if job.field.shades else 0
        self.optics = NumbaOptics(
            *edge, job.lambertian, np.float32(accuracy.sub_bins / job.bin_m), sectors
        )
        self.groups, self.centers = groups_of(self.surface, patches.diagonal_m)
        self.first, self.width = table_bins(job)

    def relay_in(self, tile: int) -> NumbaPoints:
        """Return the relay cells in tiles of some size."""
        relay = self.job.relay
        columns = relay.x_m, relay.y_m, relay.length_m, self.job.relay_weight
        return _points(columns, self.job.soft_wall_m2, tile, tiled=self._tiled)

    @property
    def sites(self) -> NumbaScene:
        """Everything that the kernels need beside beams and tables."""
        return NumbaScene(self.surface, self.groups, self.centers, self.optics, self.job.field)

    def feet(self, share: Float64) -> NumbaPoints:
        """Return the beams with a weight (n,) above 0."""
        some = np.flatnonzero(share)
        job = self.job
        x, y, _ = job.laser_spot_m[some].T
        return _points(
            (x, y, job.length_m[some], job.beam_weight[some] * share[some]),
            0.0,
            BEAM_TILE,
            tiled=self._tiled,
        )

    def tables(self, *, second_only: bool = False) -> NumbaTables:
        """Return the patches' tables; `second_only` leaves the light out that met the object once.

        Raises SceneError where they would take more than MAX_TABLE_BYTES.
        """
        per_bin = self.job.accuracy.sub_bins
        # sub-bins of each patch, and their sums to bins for each shift
        check_tables(self.job, len(self.first), per_bin * (2 * self.width + WINDOW))
        sites = self.surface, self.relay, *self.sites[3:]
        fine = sub_bins(*sites, self.first, per_bin, self.width)
        found = fine
        if self.job.more_bounces:
            found = add_interreflection(self.job, self.first, fine)
        if second_only:
            found[:, : fine.shape[1]] -= fine
        return tables(self.first, found, per_bin)

    def histograms(self) -> Float32:
        """Return histograms (n, bins) of the beams."""
        return self._summed(self.tables())

    def second_bounces(self) -> Float32:
        """Return histograms (n, bins) of light that met the object twice."""
        return self._summed(self.tables(second_only=True))

    def _summed(self, table: NumbaTables) -> Float32:
        feet = self.feet(np.ones(len(self.job.laser_spot_m)))
        tiles = np.arange(len(feet.bounds_m))
        return shift_and_add(tiles, feet, *self.sites, table, self.job.bins)[feet.place]


def check_tables(job: TransportJob, patches: int, values: int) -> None:
    """Raise SceneError if tables of some patches, with a number of float32 values for each, would
    take more than MAX_TABLE_BYTES.
    """
    needed = patches * values * np.dtype(np.float32).itemsize
    if needed > MAX_TABLE_BYTES:
        raise SceneError(
            f"tables of {patches} patches with bins of {1e3 * job.bin_m:g} mm need"
            f" {needed / 2**30:.1f} GiB, at most {MAX_TABLE_BYTES >> 30}: widen the bins, or hide"
            " an object of fewer cells"
        )


def _single(column: Float64) -> Float32:
    return np.ascontiguousarray(column, np.float32)


def _points(
    columns: tuple[Float64, Float64, Float64, Float64], soft_m2: float, tile: int, *, tiled: bool
) -> NumbaPoints:
    """Return points (n,) of the wall, in the order of compact tiles or in their own."""
    x, y, *others = (_single(column) for column in columns)
    order, place, bounds_m = _tiles(x.tobytes(), y.tobytes(), tile, tiled=tiled)
    length, weight = (column[order] for column in others)
    return NumbaPoints(
        x[order], y[order], length, weight, np.float32(soft_m2), place, bounds_m, tile
    )


@lru_cache(maxsize=8)
def _tiles(x: bytes, y: bytes, size: int, *, tiled: bool) -> tuple[Int32, Int32, Float32]:
    """Return the order of points in tiles, each point's place in it, and the tiles' bounds; kept,
    as rigs come again.

    Points are sorted along x, cut into strips, and sorted along y in each: whole tiles that are
    nearly square.
    """
    # Small tiles have tight bounds: more of them are wholly free, or join more patches.
    at_x = np.frombuffer(x, np.float32)
    at_y = np.frombuffer(y, np.float32)
    count = len(at_x)
    order = np.arange(count)
    tiles = -(-count // size)
    if tiled and tiles:
        order = np.argsort(at_x, kind="stable")
        strip = size * ceil(sqrt(tiles))
        strips = (order[begin : begin + strip] for begin in range(0, count, strip))
        order = np.concatenate([one[np.argsort(at_y[one], kind="stable")] for one in strips])
    ends = [slice(begin, begin + size) for begin in range(0, count, size)]
    bounds = [
        [f(axis[order[end]]) for axis in (at_x, at_y) for f in (np.min, np.max)] for end in ends
    ]
    place = np.empty(count, np.int32)
    place[order] = np.arange(count)
    return order.astype(np.int32), place, np.array(bounds, np.float32).reshape(-1, 4)


def _columns(points: Float64) -> tuple[Float32, Float32, Float32]:
    return _single(points[:, 0]), _single(points[:, 1]), _single(points[:, 2])


def horizons(job: TransportJob) -> tuple[Float32, Float32, NDArray[np.uint8]]:
    """Return the `horizon_table` of the job's patches at its accuracy; empty if nothing shades."""
    patches = job.patches
    field = job.field
    accuracy = job.accuracy
    if not field.shades:
        return (
            np.empty((0, 0), np.float32),
            np.empty((0, 0), np.float32),
            np.empty((0, 0, 2), np.uint8),
        )
    where = patches.row, patches.column, patches.point_m[:, 2].copy(), reach_cells(job)
    return horizon_table(field, *where, accuracy.sectors)


def reach_cells(job: TransportJob) -> Float64:
    """Return the longest leg (n,) from each patch along an axis to a beam's spot or a relay cell,
    in cells.
    """
    # The far end of a leg along an axis is at one of both extremes of all spots and cells.
    point = job.patches.point_m
    field = job.field
    relay = job.relay
    columns = (job.laser_spot_m[:, 0], relay.x_m), (job.laser_spot_m[:, 1], relay.y_m)
    low = [min(one.min() for one in axis) for axis in columns]
    high = [max(one.max() for one in axis) for axis in columns]
    across = np.maximum(high[0] - point[:, 0], point[:, 0] - low[0]) / field.pitch_x_m
    along = np.maximum(high[1] - point[:, 1], point[:, 1] - low[1]) / field.pitch_y_m
    return np.maximum(across, along)


def table_bins(job: TransportJob) -> tuple[Int32, int]:
    """Return the bin (n,) before every d3 + d4 of each patch, and the bins from there to the
    longest of any patch.

    The bins are whole vectors. d3 + d4 is convex over the wall: longest at a corner of the relay,
    and never shorter than the straight line to the mirror image of the lidar behind the wall
    (Heron).
    """
    # S4: a path's bin counts d1 + d2 + d3 + d4; the table of a patch has the last two legs.
    x, y, z = job.patches.point_m.T
    relay = job.relay
    lidar = job.lidar_m
    longest = np.zeros_like(x)
    for corner_x in (relay.x_m.min(), relay.x_m.max()):
        for corner_y in (relay.y_m.min(), relay.y_m.max()):
            d3 = np.sqrt((x - corner_x) ** 2 + (y - corner_y) ** 2 + z**2)
            longest = np.maximum(
                longest, d3 + np.linalg.norm([corner_x - lidar[0], corner_y - lidar[1], lidar[2]])
            )
    shortest = np.sqrt((x - lidar[0]) ** 2 + (y - lidar[1]) ** 2 + (z + lidar[2]) ** 2)
    bins = int((longest - shortest).max() / job.bin_m) + 3
    # A hundredth of a bin is far more than the rounding of float32.
    first = np.maximum(np.floor(shortest / job.bin_m - 0.01), 0).astype(np.int32)
    return first, (bins + LANES - 1) // LANES * LANES
