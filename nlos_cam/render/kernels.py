"""The two sums of the fast renderer, compiled: relay cells into patches' tables, tables into beams' histograms."""

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.render.legs import FAST, Optics, Points32, Surface32, geometry, scratch, shade
from nlos_cam.render.visibility import HeightField

Int32 = NDArray[np.int32]

LANES = 16
"""Rows of tables are a whole number of the widest vectors."""
BEAM_TILE = 64
"""Beams whose histograms stay in the cache while the patches go by."""


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _count(
    s: int,
    surface: Surface32,
    relay: Points32,
    optics: Optics,
    field: HeightField,
    low: Float32,
    high: Float32,
    factor: Float32,
    per_bin: int,
    histogram: Float32,
) -> int:
    """Count B over d3 + d4 of one patch in sub-bins; gives the bin at which they start."""
    cells = len(relay.x_m)
    legs = scratch(cells)
    geometry(legs, s, surface, relay, 0, cells, optics, field, True)
    if optics.sectors:
        shade(legs, s, surface, relay, 0, cells, field, low, high)
    if len(factor):
        for q in range(cells):
            legs.weight[q] *= factor[s, q]
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
    surface: Surface32,
    relay: Points32,
    optics: Optics,
    field: HeightField,
    low: Float32,
    high: Float32,
    factor: Float32,
    per_bin: int,
    width: int,
) -> tuple[Int32, Float32]:
    """Histograms (n, width * per_bin) of B over d3 + d4 in sub-bins, and the bin (n,) at which each starts."""
    patches = len(surface.x_m)
    first, histogram = np.zeros(patches, np.int32), np.zeros((patches, width * per_bin), np.float32)
    for s in numba.prange(patches):
        first[s] = _count(s, surface, relay, optics, field, low, high, factor, per_bin, histogram[s])
    return first, histogram


@numba.njit(cache=True, parallel=True)
def tables(histogram: Float32, per_bin: int) -> Float32:
    """Histograms (n, width * per_bin) in sub-bins as sums to bins (n, per_bin, width), for each shift by sub-bins."""
    patches, width = len(histogram), histogram.shape[1] // per_bin
    table = np.zeros((patches, per_bin, width), np.float32)
    for s in numba.prange(patches):
        below = np.zeros(width * per_bin + 1)  # the sum of all that comes before
        for k in range(width * per_bin):
            below[k + 1] = below[k] + histogram[s, k]
        for shift in range(per_bin):
            for i in range(width):
                table[s, shift, i] = below[(i + 1) * per_bin - shift] - below[max(i * per_bin - shift, 0)]
    return table


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_tile(
    start: int,
    count: int,
    feet: Points32,
    surface: Surface32,
    optics: Optics,
    field: HeightField,
    low: Float32,
    high: Float32,
    strength: Float32,
    first: Int32,
    table: Float32,
    bins: int,
    histogram: Float32,
) -> None:
    """Add every patch to the histograms (count, bins) of a few beams."""
    _, per_bin, width = table.shape
    log = int(np.log2(per_bin) + 0.5)
    legs = scratch(count)
    for s in range(len(table)):
        geometry(legs, s, surface, feet, start, count, optics, field, False)
        if optics.sectors:
            shade(legs, s, surface, feet, start, count, field, low, high)
        for i in range(count):
            legs.sector[i] = np.int32(
                (legs.length_m[i] + feet.length_m[start + i]) * optics.inverse_bin + np.float32(0.5)
            )
        for i in range(count):
            at = (legs.sector[i] >> log) + first[s]
            if legs.weight[i] == 0 or at >= bins:
                continue
            weight = legs.weight[i] * strength[s]
            row, out = table[s, legs.sector[i] & (per_bin - 1)], histogram[i, at : at + width]
            for k in range(width):
                out[k] += weight * row[k]


@numba.njit(cache=True, parallel=True)
def shift_and_add(
    feet: Points32,
    surface: Surface32,
    optics: Optics,
    field: HeightField,
    low: Float32,
    high: Float32,
    strength: Float32,
    first: Int32,
    table: Float32,
    bins: int,
) -> Float32:
    """Histograms (n, bins) of beams: every patch's table, times A, shifted by d1 + d2."""
    beams = len(feet.x_m)
    histogram = np.zeros((beams, (bins + table.shape[2] + LANES) // LANES * LANES), np.float32)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        end = min(start + BEAM_TILE, beams)
        _add_tile(
            start,
            end - start,
            feet,
            surface,
            optics,
            field,
            low,
            high,
            strength,
            first,
            table,
            bins,
            histogram[start:end],
        )
    return histogram
