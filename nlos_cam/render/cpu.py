"""The fast renderer: S2 factorised at the object's patches, for the CPU (numba, float32).

weight(p, s, q) = A(p, s) B(s, q) and length = (d1 + d2)(p, s) + (d3 + d4)(s, q). So each patch s gets one table of B
over d3 + d4, and each beam p adds it, shifted by d1 + d2. Beside each table bin's sum T stands its moment M about the
bin's middle, so that a shift by a fraction f of a bin moves f T + 6 f (1 - f) M to the next bin: second order, where a
plain split is first. |M| <= T / 6 keeps the density behind that non-negative.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.render.beams import Beams
from nlos_cam.render.reference import occluded
from nlos_cam.render.relay import Relay
from nlos_cam.render.scene import Patches
from nlos_cam.render.visibility import sector

Array = NDArray[np.float64]

BEAM_TILE, PATCH_TILE = 16, 48
"""A tile's tables and histograms stay in the first cache."""


@numba.njit(cache=True)
def _lit(point: Array, normal: Array, horizons: Float32, x: float, y: float, edge_x: float, edge_z: float) -> float:
    """Leg to the wall point (x, y) times the patch's normal, not normalised; 0 where V is 0."""
    dx, dy = x - point[0], y - point[1]
    facing = normal[0] * dx + normal[1] * dy - normal[2] * point[2]
    if facing <= 0 or occluded(point[0], point[2], x, 0.0, edge_x, edge_z):
        return 0.0
    if point[2] < np.sqrt(dx * dx + dy * dy) * horizons[sector(dx, dy)]:
        return 0.0
    return facing


@numba.njit(cache=True, parallel=True)
def _first_bins(
    points: Array, x: Array, y: Array, d4: Array, bin_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    first, last = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    for s in numba.prange(len(points)):
        shortest, longest = np.inf, 0.0
        for q in range(len(x)):
            length = np.sqrt((x[q] - points[s, 0]) ** 2 + (y[q] - points[s, 1]) ** 2 + points[s, 2] ** 2) + d4[q]
            shortest, longest = min(shortest, length), max(longest, length)
        first[s], last[s] = int(np.floor(shortest / bin_m)), int(np.floor(longest / bin_m))
    return first, last


@numba.njit(cache=True, parallel=True)
def _tables(
    points: Array,
    normals: Array,
    horizons: Float32,
    x: Array,
    y: Array,
    d4: Array,
    edge_x: float,
    edge_z: float,
    bin_m: float,
    first: NDArray[np.int64],
    width: int,
) -> tuple[Float32, Float32]:
    """Sums and moments (n, width + 2) of B over d3 + d4, each with an empty bin at either end."""
    sums, moments = np.zeros((len(points), width + 2), np.float32), np.zeros((len(points), width + 2), np.float32)
    for s in numba.prange(len(points)):
        total, moment = np.zeros(width), np.zeros(width)
        for q in range(len(x)):
            if _lit(points[s], normals[s], horizons[s], x[q], y[q], edge_x, edge_z) == 0.0:
                continue
            d3_squared = (x[q] - points[s, 0]) ** 2 + (y[q] - points[s, 1]) ** 2 + points[s, 2] ** 2
            d3 = np.sqrt(d3_squared)
            b = points[s, 2] / (d3 * d3_squared * d4[q] * d4[q])  # cos t3 / (d3^2 d4^2)
            place = (d3 + d4[q]) / bin_m - first[s]
            k = int(place)  # not negative: first is this patch's own floor
            total[k] += b
            moment[k] += b * (place - k - 0.5)
        for k in range(width):
            limit = total[k] / 6
            sums[s, k + 1] = total[k]
            moments[s, k + 1] = min(max(moment[k], -limit), limit)
    return sums, moments


@numba.njit(cache=True, parallel=True, fastmath={"contract", "reassoc", "nsz"})
def _shift_and_add(
    foot: Array,
    d1: Array,
    cos_1: Array,
    points: Array,
    normals: Array,
    beta: Array,
    horizons: Float32,
    sums: Float32,
    moments: Float32,
    first: NDArray[np.int64],
    edge_x: float,
    edge_z: float,
    scale: float,
    bin_m: float,
    bins: int,
) -> Float32:
    beams, patches, width = len(foot), len(points), sums.shape[1] - 1
    histogram = np.zeros((beams, bins + width), np.float32)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        p_end = min((tile + 1) * BEAM_TILE, beams)
        for s_start in range(0, patches, PATCH_TILE):
            for p in range(tile * BEAM_TILE, p_end):
                for s in range(s_start, min(s_start + PATCH_TILE, patches)):
                    facing = _lit(points[s], normals[s], horizons[s], foot[p, 0], foot[p, 1], edge_x, edge_z)
                    if facing == 0.0:
                        continue
                    dx, dy, dz = foot[p, 0] - points[s, 0], foot[p, 1] - points[s, 1], points[s, 2]
                    d2_squared = dx * dx + dy * dy + dz * dz
                    d2 = np.sqrt(d2_squared)
                    a = scale * cos_1[p] * facing * beta[s] / (d2 * d2_squared)  # cos t1 cos t2 beta / d2^2
                    place = (d1[p] + d2) / bin_m
                    k = int(place)
                    f = place - k
                    start = k + first[s]
                    if start >= bins:
                        continue
                    g = 6 * f * (1 - f)
                    stay, move, lean = np.float32(a * (1 - f)), np.float32(a * f), np.float32(a * g)
                    out = histogram[p, start : start + width]
                    t_here, t_before = sums[s, 1 : width + 1], sums[s, :width]
                    m_here, m_before = moments[s, 1 : width + 1], moments[s, :width]
                    for i in range(width):
                        out[i] += stay * t_here[i] + move * t_before[i] + lean * (m_before[i] - m_here[i])
    return histogram


def transient(
    beams: Beams,
    chosen: NDArray[np.int64],
    patches: Patches,
    relay: Relay,
    edge: tuple[float, float],
    horizons: Float32,
    bin_m: float,
    bins: int,
) -> Float32:
    """Histograms (len(chosen), bins) of I_multi over path length, for some beams that light the wall.

    Does not depend on the number of threads: each histogram is summed by one thread, patches in order.
    """
    points, normals = patches.point_m, patches.normal
    first, last = _first_bins(points, relay.x_m, relay.y_m, relay.length_m, bin_m)
    width = int((last - first).max()) + 1
    wall = relay.x_m, relay.y_m, relay.length_m
    sums, moments = _tables(points, normals, horizons, *wall, *edge, bin_m, first, width)
    scale = relay.cell_m2 * patches.cell_m2 / (2 * np.pi) ** 3  # I0 = 1
    histogram = _shift_and_add(
        np.ascontiguousarray(beams.foot_m[chosen]),
        beams.length_m[chosen],
        beams.cos_incidence[chosen],
        points,
        normals,
        patches.beta,
        horizons,
        sums,
        moments,
        first,
        *edge,
        scale,
        bin_m,
        bins,
    )
    return histogram[:, :bins]
