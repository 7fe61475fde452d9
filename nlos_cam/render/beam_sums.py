"""Sums of the patches' tables for each beam, compiled in float32: a tile of beams at a time,
neighbors joined.

A beam adds one row of a table for each patch, shifted by its own path. Over a tile of beams, two
neighboring patches differ in path by nearly the same length and in weight by nearly the same ratio.
So the tile joins their tables first, and each beam adds one row for all of them. Patches are joined
only where that moves no path by more than JOIN_SUB_BINS sub-bins, and half of one for rounding. The
more sub-bins an accuracy has, the fewer patches are joined.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Int32, Int64, Mask
from numpy.typing import NDArray

from nlos_cam.frames import inner, int64
from nlos_cam.render.echoes import strongest_between
from nlos_cam.render.legs import (
    BEAM_TILE,
    DARK,
    FAST,
    FREE,
    WINDOW,
    NumbaLegs,
    NumbaOptics,
    NumbaPoints,
    NumbaSurface,
    add_rows,
    fill,
    geometry,
    judge,
    scratch,
)
from nlos_cam.render.visibility import HeightField

PATCH_BLOCK = 8
"""Patches, or groups, whose legs are computed before their rows are added."""
GROUP = 4
"""Most patches of a group: 2 x 2 neighbors."""
JOIN_SUB_BINS = np.float32(1.5)
"""Sub-bins by which a path may move, at most, where patches are joined."""
JOIN_WEIGHT = np.float32(0.25)
"""Relative change of a leg's weight by distance where patches are joined, at most, times sub-bins
per bin from 4 on.
"""
JOIN_COSINE = 4
"""The change by a patch's cosine may be so many times as large: neighbors' tilts differ in any
direction.
"""
MARGIN = 16
"""Bins by which the rows of joined tables are longer."""
ROUNDED = np.float32(1.001)
"""Factor on a bound, more than the rounding of its sum."""


class NumbaTables(NamedTuple):
    """Tables of the patches (n): B over d3 + d4 in bins, for each shift within a bin."""

    first: Int32
    """(n,); bin at which a patch's rows start."""
    rows: Float32
    """Flat; n * per_bin rows of WINDOW zeros and `width` bins, then WINDOW zeros: a window reads
    beyond both ends.
    """
    rest: Float32
    """(n, width + 1); largest value of any shift from a bin of the row on."""
    per_bin: int
    width: int


class NumbaGroups(NamedTuple):
    """Patches in groups (k) of neighbors."""

    member: Int32
    """(n,); patches, group by group."""
    begin: Int32
    """(k + 1,); first member of each group."""
    reach_m: Float32
    """(k,); distance from the mean to the farthest member."""


class NumbaScene(NamedTuple):
    """Everything on the way of light that depends on neither beams nor tables."""

    surface: NumbaSurface
    groups: NumbaGroups
    centers: NumbaSurface
    """The groups' means, as if each were one patch."""
    optics: NumbaOptics
    field: HeightField


class Windows(NamedTuple):
    """Windows of bins that a tile's beams (count) sum."""

    start: int
    """Place of the first beam."""
    length_m: Float32
    """(count,); d1."""
    begin: Int32
    """(count,); first bin of each window."""
    sums: Float32
    """(count, whole WINDOWs)."""
    bound: Float32
    """(count,); upper bound on any bin beyond the window."""


class RowSource(NamedTuple):
    """Rows of one patch or joined group in a flat table."""

    per_bin: int
    stride: int
    """Numbers from one row to the next."""
    first: int
    """Bin at which the rows start."""
    strength: np.float32


class Block(NamedTuple):
    """Legs of up to PATCH_BLOCK patches or groups to a tile's beams, whose rows are not added
    yet.
    """

    weights: Float32
    """Flat; (PATCH_BLOCK, count)."""
    offsets: Int32
    row: Int32
    """(PATCH_BLOCK, count); place of a leg's row in the patch's table."""
    ahead: Int32
    """(PATCH_BLOCK, count); bin of the row at which the beam's window begins."""
    base: Int64


class Joins(NamedTuple):
    """Groups that a tile of beams joins."""

    joined: Mask
    """(k,)."""
    shift: Int64
    """(n,), in the order of `member`; sub-bins by which a member's path is longer than its
    mean's.
    """
    ratio: Float32
    """(n,), in that order; a member's weight over its mean's, 0 without light."""


@numba.njit(cache=True, inline="always")
def _block(count: int) -> Block:
    row = np.empty((PATCH_BLOCK, count), np.int32)
    ahead = np.empty((PATCH_BLOCK, count), np.int32)
    weights = np.empty(PATCH_BLOCK * count, np.float32)
    offsets = np.empty(PATCH_BLOCK * count, np.int32)
    return Block(weights, offsets, row, ahead, np.empty(PATCH_BLOCK, np.int64))


@inner(error_model="numpy", fastmath=FAST)
def ends(
    start: int,
    count: int,
    feet: NumbaPoints,
    groups: NumbaGroups,
    centers: NumbaSurface,
    optics: NumbaOptics,
    table: NumbaTables,
) -> tuple[Float32, int]:
    """Return a bin (count,) before every path of each beam, and the bins from there to the last
    path of any beam.
    """
    near = np.full(count, np.float32(np.inf))
    far = np.zeros(count, np.float32)
    at_x = feet.x_m[start : start + count]
    at_y = feet.y_m[start : start + count]
    # A group at a time with all beams side by side: the inner loop is made of vectors.
    for g in range(len(groups.reach_m)):
        x = centers.x_m[g]
        y = centers.y_m[g]
        z = centers.z_m[g]
        first = table.first[groups.member[groups.begin[g]]]
        last = int64(0)
        for j in range(groups.begin[g], groups.begin[g + 1]):
            first = min(first, table.first[groups.member[j]])
            last = max(last, table.first[groups.member[j]])

        # Triangle inequality: a member's d2 differs from its mean's by at most the group's reach.
        reach = groups.reach_m[g] * optics.inverse_bin
        soonest = np.float32(first * table.per_bin) - reach
        latest = np.float32(last * table.per_bin) + reach
        for i in range(count):
            dx = at_x[i] - x
            dy = at_y[i] - y
            length = np.sqrt(dx * dx + dy * dy + z * z) * optics.inverse_bin
            near[i] = min(near[i], length + soonest)
            far[i] = max(far[i], length + latest)

    spread = 0
    whole = np.float32(1 / table.per_bin)
    for i in range(count):
        spread = max(spread, int((far[i] - near[i]) * whole))
        # A beam's first path is d1 + min (d2 + d3 + d4) over the patches; one bin less covers
        # rounding.
        before = (near[i] + feet.length_m[start + i] * optics.inverse_bin) * whole
        near[i] = np.floor(before) - np.float32(1)
    return near, spread + table.width + 4


@numba.njit(cache=True, inline="always")
def _bits(number: int) -> int:
    """Return the logarithm of a power of two: shifts are ten times faster than divisions."""
    bits = int64(0)
    while number >> bits > 1:
        bits += 1
    return bits


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _place(
    legs: NumbaLegs,
    windows: Windows,
    inverse_bin: np.float32,
    source: RowSource,
    used: int,
    block: Block,
) -> tuple[np.float32, int]:
    """Fill in each leg's weight, row of a table, and bin of the row at which the beam's window
    begins.

    Return the sum of the weights, and the smallest of those bins.
    """
    # Numbers are 32 bits wide, so that the loop is made of vectors: numba's own integers are wider,
    # and floats have no smallest one without order.
    total = np.float32(0)
    least = np.int32(1 << 30)
    count = len(windows.begin)
    begin = windows.begin
    length_m = windows.length_m
    weight = block.weights[used * count : (used + 1) * count]
    row = block.row[used]
    ahead = block.ahead[used]
    starts = np.int32(source.first)
    bits = _bits(source.per_bin)
    mask = np.int32(source.per_bin - 1)
    long = np.int32(source.stride)
    for i in range(count):
        # d1 + d2 to the nearest sub-bin: its whole bins move the window along the row, the sub-bins
        # that are left choose among the rows.
        shift = np.int32((legs.length_m[i] + length_m[i]) * inverse_bin + np.float32(0.5))
        weight[i] = legs.weight[i] * source.strength
        row[i] = np.int32((shift & mask) * long)
        at = np.int32(begin[i] - np.int32(shift >> bits) - starts)
        ahead[i] = at
        total += weight[i]
        least = min(least, at)
    return total, int64(least)


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _raise_bound(windows: Windows, used: int, block: Block, largest: np.float32) -> None:
    """Add to each beam's bound the most that a placed table, of values up to `largest`, can add."""
    count = len(windows.begin)
    weight = block.weights[used * count : (used + 1) * count]
    for i in range(count):
        windows.bound[i] += weight[i] * largest


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _add_block(used: int, rows: Float32, row_bins: int, block: Block, sums: Float32) -> None:
    """Add the rows of some patches, placed by `_place`, to the windows (count, windows * WINDOW) of
    a tile's beams.
    """
    count = sums.shape[0]
    bins = sums.shape[1]
    width = np.int32(row_bins)
    every = sums.ravel()
    offset = block.offsets.reshape(PATCH_BLOCK, count)
    # Windows outside, beams inside: all offsets of a window are computed as vectors, then each
    # beam's window stays in registers while the rows of the block are added to it.
    for window in range(0, bins, WINDOW):
        ahead_of = np.int32(window)
        before = np.int32(-WINDOW)
        for j in range(used):
            for i in range(count):
                # Before and beyond a row lie WINDOW zeros: clamped, a window adds nothing there.
                at = min(max(np.int32(block.ahead[j, i] + ahead_of), before), width)
                offset[j, i] = np.int32(block.row[j, i] + at)
        for i in range(count):
            add_rows(
                every,
                i * bins + window,
                rows,
                block.base,
                block.offsets,
                block.weights,
                i,
                count,
                used,
            )


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _leg(
    s: int, surface: NumbaSurface, x: np.float32, y: np.float32, optics: NumbaOptics
) -> tuple[np.float32, np.float32, np.float32]:
    """Return length, facing and weight of the leg from a patch to a point (x, y) of the wall beyond
    near contact.
    """
    dx = x - surface.x_m[s]
    dy = y - surface.y_m[s]
    z = surface.z_m[s]
    squared = dx * dx + dy * dy + z * z
    length = np.sqrt(squared)
    facing = surface.normal_x[s] * dx + surface.normal_y[s] * dy - surface.normal_z[s] * z
    weight = facing / (length * squared)
    return length, facing, weight * z / length if optics.lambertian else weight


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _near_enough(
    g: int,
    bounds_m: Float32,
    groups: NumbaGroups,
    centers: NumbaSurface,
    optics: NumbaOptics,
    limit: np.float32,
) -> bool:
    """Return whether joining a group moves no path of a tile (4,) by more than JOIN_SUB_BINS, and
    no weight, apart from the patch's cosine, by more than `limit` of it.
    """
    # Patches a and b, r apart, have legs l_a and l_b to a point of the wall that is at least d from
    # the segment between them. Over the wall, grad l is the leg's unit vector u. Moving the patch
    # by r turns u by at most r / d, so
    #     |grad (l_a - l_b)| = |u_a - u_b| <= r / d.
    # A weight falls with l^-k (S2: k = 3, as the cosine has l once; 4 if Lambertian),
    # so grad log w = -k u / l. The map from p to u / l is an inversion, which scales by 1 / l^2:
    #     |grad log (w_a / w_b)| <= 4 r / d^2.
    # Both differences are 0 at the tile's middle after joining, and grow over at most half its
    # diagonal. Near contact, where weights follow another law, nothing is joined.
    half_x = (bounds_m[1] - bounds_m[0]) / 2
    half_y = (bounds_m[3] - bounds_m[2]) / 2
    nothing = np.float32(0)
    out_x = max(abs(centers.x_m[g] - bounds_m[0] - half_x) - half_x, nothing)
    out_y = max(abs(centers.y_m[g] - bounds_m[2] - half_y) - half_y, nothing)
    z = centers.z_m[g]
    reach = groups.reach_m[g]
    nearest = np.sqrt(out_x * out_x + out_y * out_y + z * z) - reach
    # Half the diagonal times r; over d it is the most that a path moves, in meters.
    moving_m2 = np.sqrt(half_x * half_x + half_y * half_y) * reach
    return (
        nearest > nothing
        and nearest * nearest >= optics.near_m2
        and moving_m2 * optics.inverse_bin <= JOIN_SUB_BINS * nearest
        and 4 * moving_m2 <= limit * nearest * nearest
    )


@numba.njit(cache=True, inline="always")
def _first(g: int, groups: NumbaGroups, joins: Joins, table: NumbaTables) -> tuple[int, int]:
    """Return the first bin of a group's joined rows, and the last at which a member's row starts; 0
    without light.
    """
    first = int64(1 << 40)
    last = int64(0)
    bits = _bits(table.per_bin)
    # A member's rows start later by its path's shift, which a row's own shift within a bin may
    # carry into the next bin.
    for j in range(groups.begin[g], groups.begin[g + 1]):
        if joins.ratio[j] > 0:
            own = table.first[groups.member[j]]
            first = min(first, own + (joins.shift[j] >> bits))
            last = max(last, own + ((joins.shift[j] + table.per_bin - 1) >> bits))
    return first, last


@numba.njit(cache=True, inline="always")
def _joinable(g: int, verdicts: NDArray[np.int8], groups: NumbaGroups) -> bool:
    """Return whether a group has two free members or more, and none that may be blocked."""
    free = 0
    mixed = 0
    for j in range(groups.begin[g], groups.begin[g + 1]):
        verdict = verdicts[groups.member[j]]
        free += int(verdict == FREE)
        mixed += int((verdict != FREE) & (verdict != DARK))
    return mixed == 0 and free >= 2


@inner(error_model="numpy", fastmath=FAST)
def _joins(
    verdicts: NDArray[np.int8], bounds_m: Float32, scene: NumbaScene, table: NumbaTables
) -> Joins:
    """Return which groups a tile (4,) of beams joins: those whose free members it cannot tell
    apart.
    """
    surface = scene.surface
    groups = scene.groups
    centers = scene.centers
    optics = scene.optics
    count = len(groups.reach_m)
    joins = Joins(
        np.zeros(count, np.bool_),
        np.zeros(len(verdicts), np.int64),
        np.zeros(len(verdicts), np.float32),
    )
    x = (bounds_m[0] + bounds_m[1]) / 2
    y = (bounds_m[2] + bounds_m[3]) / 2
    limit = JOIN_WEIGHT / np.float32(max(table.per_bin, 4))
    nothing = np.float32(0)
    half = np.float32(0.5)
    for g in range(count):
        if not _joinable(g, verdicts, groups) or not _near_enough(
            g, bounds_m, groups, centers, optics, limit
        ):
            continue
        length, facing, weight = _leg(g, centers, x, y, optics)
        alike = facing > 0
        for j in range(groups.begin[g], groups.begin[g + 1]):
            s = int64(groups.member[j])
            if verdicts[s] == DARK:
                continue
            own_length, own_facing, own_weight = _leg(s, surface, x, y, optics)
            # The cosine's part f = n . (q - p) is affine in the wall's point q. Where f_g > 0, the
            # points with f_s / f_g <= c fill a half plane, so the quotient is largest and smallest
            # at corners c of the tile. Against the middle m it may change by
            #     |f_s(c) f_g(m) / (f_g(c) f_s(m)) - 1| <= JOIN_COSINE limit,
            # which is tested without the division.
            for corner in range(4):
                to_x = bounds_m[corner & 1]
                to_y = bounds_m[2 + (corner >> 1)]
                one = _leg(s, surface, to_x, to_y, optics)[1]
                other = _leg(g, centers, to_x, to_y, optics)[1]
                off = abs(one * facing - other * own_facing)
                alike &= (
                    (one > nothing)
                    & (other > nothing)
                    & (off <= JOIN_COSINE * limit * other * own_facing)
                )
            joins.shift[j] = int64(np.floor((own_length - length) * optics.inverse_bin + half))
            joins.ratio[j] = surface.strength[s] * own_weight / weight
        first, last = _first(g, groups, joins, table)
        joins.joined[g] = alike and first <= last <= first + MARGIN
    return joins


@inner(error_model="numpy", fastmath=FAST)
def _build(
    group: Int64,
    ahead: Int32,
    bins: int,
    groups: NumbaGroups,
    joins: Joins,
    table: NumbaTables,
    rows: Float32,
) -> None:
    """Fill in the joined rows of some groups, where windows of `bins` bins from `ahead` (k, count)
    on meet them.
    """
    # Row r of the group is sum_j ratio_j T_j(r + shift_j), each T_j at its member's own first bin.
    # Only the part of it that some beam's window meets is summed, one window at a time.
    stride = WINDOW + table.width
    wide = table.width + MARGIN
    bits = _bits(table.per_bin)
    base = np.empty(GROUP, np.int64)
    offset = np.empty(GROUP, np.int32)
    off = np.empty(GROUP, np.int64)
    for k in range(len(group)):
        count = groups.begin[group[k] + 1] - groups.begin[group[k]]
        begin = groups.begin[group[k]]
        first = _first(group[k], groups, joins, table)[0]
        low = min(max(int64(ahead[k].min()), 0), wide)
        high = max(min(int64(ahead[k].max()) + bins, wide), 0)
        for r in range(table.per_bin):
            for j in range(count):
                s = groups.member[begin + j]
                at = r + joins.shift[begin + j]
                off[j] = (at >> bits) + table.first[s] - first
                base[j] = (s * table.per_bin + (at & (table.per_bin - 1))) * stride + WINDOW
            # Beyond the members' last bins the sums are 0, so what lies there, before the next row,
            # stays 0.
            for window in range(low, high, WINDOW):
                to = (k * table.per_bin + r) * (WINDOW + wide) + WINDOW + window
                for j in range(count):
                    offset[j] = min(max(window - off[j], -WINDOW), table.width)
                for i in range(WINDOW):
                    rows[to + i] = 0
                add_rows(
                    rows,
                    to,
                    table.rows,
                    base,
                    offset,
                    joins.ratio[begin:],
                    int64(0),
                    int64(1),
                    int64(count),
                )


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _largest_joined(
    g: int, groups: NumbaGroups, joins: Joins, table: NumbaTables, first: int, beyond: int
) -> np.float32:
    """Return a bound on a group's joined rows, which start at bin `first`, from their bin `beyond`
    on.
    """
    # |sum_j ratio_j T_j(k)| <= sum_j ratio_j max T_j, as no table has a value below 0.
    largest = np.float32(0)
    bits = _bits(table.per_bin)
    for j in range(groups.begin[g], groups.begin[g + 1]):
        s = groups.member[j]
        off = table.first[s] + ((joins.shift[j] + table.per_bin - 1) >> bits) - first
        largest += joins.ratio[j] * table.rest[s, min(max(beyond - off, 0), table.width)]
    return largest


@inner(error_model="numpy", fastmath=FAST)
def _add_joined(
    windows: Windows, feet: NumbaPoints, scene: NumbaScene, joins: Joins, table: NumbaTables
) -> None:
    """Add the joined groups to the windows of a tile's beams, and to the bound on every bin
    beyond.
    """
    groups = scene.groups
    centers = scene.centers
    optics = scene.optics
    sums = windows.sums
    count = len(windows.begin)
    bins = sums.shape[1]
    wide = table.width + MARGIN
    size = table.per_bin * (WINDOW + wide)
    legs = scratch(count)
    block = _block(count)
    rows = np.zeros(PATCH_BLOCK * size + 2 * WINDOW, np.float32)
    group = np.empty(PATCH_BLOCK, np.int64)
    used = 0
    for g in range(len(joins.joined)):
        if joins.joined[g]:
            first = _first(g, groups, joins, table)[0]
            geometry(legs, g, centers, feet, windows.start, count, optics, False)
            # The members' strengths are in the joined rows.
            source = RowSource(table.per_bin, WINDOW + wide, first, np.float32(1))
            _, least = _place(legs, windows, optics.inverse_bin, source, used, block)
            largest = _largest_joined(g, groups, joins, table, first, least + bins)
            _raise_bound(windows, used, block, largest)
            block.base[used] = used * size + WINDOW
            group[used] = g
            used += 1
        if used == PATCH_BLOCK or (used and g + 1 == len(joins.joined)):
            _build(group[:used], block.ahead, bins, groups, joins, table, rows)
            _add_block(used, rows, wide, block, sums)
            used = 0


@inner(error_model="numpy", fastmath=FAST)
def _add_single(
    windows: Windows,
    feet: NumbaPoints,
    scene: NumbaScene,
    verdicts: NDArray[np.int8],
    joins: Joins,
    table: NumbaTables,
) -> None:
    """Add the patches that are not joined to the windows of a tile's beams, and to the bound on
    every bin beyond.
    """
    surface = scene.surface
    groups = scene.groups
    optics = scene.optics
    field = scene.field
    sums = windows.sums
    start = windows.start
    count = len(windows.begin)
    bins = sums.shape[1]
    stride = WINDOW + table.width
    legs = scratch(count)
    block = _block(count)
    used = 0
    for g in range(len(joins.joined)):
        if joins.joined[g]:
            continue
        for j in range(groups.begin[g], groups.begin[g + 1]):
            s = int64(groups.member[j])
            if verdicts[s] == DARK:
                continue
            fill(legs, s, surface, feet, start, count, int64(verdicts[s]), optics, field, False)
            first = int64(table.first[s])
            source = RowSource(table.per_bin, stride, first, np.float32(surface.strength[s]))
            total, least = _place(legs, windows, optics.inverse_bin, source, used, block)
            if total > 0:
                # S2 factorized: h(k) = sum_s A(p, s) T_s(k - at_s). Beyond the window T_s is at
                # most its largest value from there on.
                beyond = min(max(least + bins, 0), table.width)
                largest = np.float32(table.rest[s, beyond])
                _raise_bound(windows, used, block, largest)
                block.base[used] = s * table.per_bin * stride + WINDOW
                used += 1
                if used == PATCH_BLOCK:
                    _add_block(used, table.rows, table.width, block, sums)
                    used = 0
    _add_block(used, table.rows, table.width, block, sums)


@inner()
def _sum_tile(
    start: int, feet: NumbaPoints, scene: NumbaScene, table: NumbaTables, most: int
) -> Windows:
    """Return the windows of a tile's beams, over `most` bins or all, with every patch added."""
    surface = scene.surface
    optics = scene.optics
    count = min(BEAM_TILE, len(feet.x_m) - start)
    near, span = ends(start, count, feet, scene.groups, scene.centers, optics, table)
    windows = Windows(
        start,
        feet.length_m[start : start + count],
        near.astype(np.int32),
        np.zeros((count, (min(span, most) + WINDOW - 1) // WINDOW * WINDOW), np.float32),
        np.zeros(count, np.float32),
    )
    tile = feet.bounds_m[start // BEAM_TILE : start // BEAM_TILE + 1]
    verdicts = judge(int64(0), len(table.first), surface, tile, optics, scene.field)[:, 0]
    joins = _joins(verdicts, tile[0], scene, table)
    # Legs of some patches first, then the rows of each beam: rows and windows stay in the first
    # cache.
    _add_joined(windows, feet, scene, joins, table)
    _add_single(windows, feet, scene, verdicts, joins, table)
    return windows


@numba.njit(cache=True, parallel=True)
def shift_and_add(
    tiles: Int64,
    feet: NumbaPoints,
    surface: NumbaSurface,
    groups: NumbaGroups,
    centers: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    table: NumbaTables,
    bins: int,
) -> Float32:
    """Return histograms (k * BEAM_TILE, bins) of the beams of k tiles.

    They are the sum of every patch's table, times A, shifted by d1 + d2. Beams are summed by whole
    tiles, so that their bits do not depend on which are asked for.
    """
    histogram = np.zeros((len(tiles) * BEAM_TILE, bins), np.float32)
    # The scene comes in parts, as numba's parallel loops take no nested tuples.
    for k in numba.prange(len(tiles)):
        scene = NumbaScene(surface, groups, centers, optics, field)
        windows = _sum_tile(int64(tiles[k] * BEAM_TILE), feet, scene, table, bins)
        for i in range(len(windows.begin)):
            first = int(windows.begin[i])
            for j in range(max(-first, 0), min(windows.sums.shape[1], bins - first)):
                histogram[k * BEAM_TILE + i, first + j] = windows.sums[i, j]
    return histogram


@numba.njit(cache=True, parallel=True)
def strongest_in_window(
    feet: NumbaPoints,
    surface: NumbaSurface,
    groups: NumbaGroups,
    centers: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    table: NumbaTables,
    bins: int,
) -> tuple[NDArray[np.int64], Float32, Float32, NDArray[np.bool_]]:
    """Return bin, value and runner-up (n,) of the strongest of each beam's first WINDOW bins, and
    if no other can win.

    Light comes back strongest from the shortest paths, so the first window nearly always holds both
    bins.
    """
    beams = len(feet.x_m)
    winner = np.zeros(beams, np.int64)
    peak = np.zeros(beams, np.float32)
    second = np.zeros(beams, np.float32)
    sure = np.zeros(beams, np.bool_)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        scene = NumbaScene(surface, groups, centers, optics, field)
        windows = _sum_tile(start, feet, scene, table, int64(WINDOW))
        for i in range(len(windows.begin)):
            first = int(windows.begin[i])
            best = strongest_between(windows.sums[i], max(-first, 0), min(WINDOW, bins - first))
            winner[start + i] = best[0] + first
            peak[start + i] = best[1]
            second[start + i] = best[2]
            # A bin beyond the window is at most the bound, so it is neither of the two if the bound
            # does not exceed the second, by more than float32 rounds.
            sure[start + i] = windows.bound[i] * ROUNDED <= best[2]
    return winner[feet.place], peak[feet.place], second[feet.place], sure[feet.place]


def groups_of(surface: NumbaSurface, diagonal_m: float) -> tuple[NumbaGroups, NumbaSurface]:
    """Return patches in groups of 2 x 2 neighbors, and the groups' means.

    A group with a member farther from the mean than the diagonal of a cell, as across an edge, is
    broken up.
    """
    which = _numbered((surface.row // 2) * (1 << 20) + surface.column // 2)
    count, means, reach_m = _means(surface, which)
    far = reach_m[which] > diagonal_m
    if far.any():
        which = _numbered(np.where(far, len(which) + np.arange(len(which)), which))
        count, means, reach_m = _means(surface, which)

    begin = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    member = np.argsort(which, kind="stable").astype(np.int32)
    # The kernels ask for a mean's place, normal and near contact alone.
    columns = {name: column[:0] for name, column in surface._asdict().items()}
    columns.update(zip(surface._fields, means, strict=False))
    return NumbaGroups(member, begin, reach_m * ROUNDED), surface._replace(**columns)


def _numbered(label: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return labels (n,) as numbers from 0 on."""
    return np.unique(label, return_inverse=True)[1]


def _means(
    surface: NumbaSurface, which: NDArray[np.intp]
) -> tuple[NDArray[np.intp], list[Float32], Float32]:
    """Return size and mean columns of the groups in which patches (n,) are, and the distance to the
    farthest member.
    """
    columns = surface[:7]  # up to soft_m2
    count = np.bincount(which)
    means = [(np.bincount(which, column) / count).astype(np.float32) for column in columns]
    squared = [
        np.square(column - mean[which]) for column, mean in zip(columns[:3], means[:3], strict=True)
    ]
    reach_m = np.zeros(len(count), np.float32)
    np.maximum.at(reach_m, which, np.sqrt(np.sum(squared, axis=0)))
    return count, means, reach_m
