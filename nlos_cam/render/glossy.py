"""Glossy surfaces on the CPU: a BRDF as a sum of products, each of a function of one leg and the same of the other.

An isotropic, reciprocal BRDF is a symmetric function of two directions, so it has eigenfunctions on the hemisphere
about the normal: f(in, out) = sum_r l_r e_r(in) e_r(out), with e_r = g_r(x) cos(m phi) or g_r(x) sin(m phi) and x =
sqrt(1 - cosine). S2 then factorizes again, once for each r: a patch has a table of B e_r for every r, and a beam adds
them all with the weights l_r e_r. The largest terms come first, as many as keep the error within the accuracy's: about
5 for each unit of a lobe's exponent. Reciprocity is exact, whatever the number of terms.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int64
from numpy.typing import NDArray

from nlos_cam.render import backend_numba
from nlos_cam.render.backend_numba import NumbaJob, returns
from nlos_cam.render.beam_sums import ROUNDED, NumbaGroups, NumbaTables, ends
from nlos_cam.render.brdf_table import nodes, scattered, scattering
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
from nlos_cam.render.material import Brdf
from nlos_cam.render.visibility import HeightField

POINTS = 48, 96, 192
"""Gauss points of x in the order in which they are tried."""
STEPS = 512
"""Steps of x in the table of the functions."""
PROBES = 4096
"""Paths on which the error is measured."""
MAX_RANK = 2048
TABLE_BYTES = 1 << 24
"""Memory for the tables of the patches whose rows are added together."""


class Basis(NamedTuple):
    """Functions of one direction (R), of an eigenfunction with m > 0 two."""

    value: Float32
    """(STEPS + 2, R); sqrt |l| g(x), the last row a copy for the upper end."""
    harmonic: NDArray[np.int32]
    """(R,); 2 m for cos(m phi), 2 m + 1 for sin(m phi)."""
    sign: Float32
    """(R,); of l."""
    largest: float
    """Largest value of the BRDF."""


@lru_cache(maxsize=8)
def eigenfunctions(brdf: Brdf, points: int) -> Basis:
    """Return the functions of a BRDF, the largest |l| first, from a grid of `points` x and twice as many angles."""
    node, weight = np.polynomial.legendre.leggauss(points)
    x, turn = (node + 1) / 2, np.arange(points + 1) * np.pi / points
    cosine = 1 - x**2
    sine = np.sqrt(1 - cosine**2)
    across, along = sine[:, None, None] * sine[None, :, None], cosine[:, None, None] * cosine[None, :, None]
    f = brdf(cosine[:, None, None], cosine[None, :, None], along + across * np.cos(turn)) + np.zeros_like(across * turn)
    # Fourier series in the angle between the azimuths, even: f = sum_m f_m(x, x') cos(m turn).
    series = np.fft.rfft(np.concatenate([f, f[..., -2:0:-1]], -1)).real / points
    series[..., 0] /= 2
    orders = np.flatnonzero(np.abs(series[..., :points]).max((0, 1)) > 1e-7 * np.abs(f).max())
    # The solid angle of a ring is 2 pi sin dtheta = 4 pi x dx: its root on both sides keeps the matrix symmetric.
    root = np.sqrt(weight * x)
    strength, vector = np.linalg.eigh(np.moveaxis(series[..., orders], -1, 0) * root * root[:, None])
    which, k = np.nonzero(np.abs(strength) > 1e-7 * np.abs(strength).max())
    order = np.argsort(-np.abs(strength[which, k]), kind="stable")
    which, k = which[order], k[order]
    # From the Gauss points to an even grid by the polynomial through them, which Gauss quadrature gives in Legendre's.
    degree = np.arange(points)
    of_node, of_step = (
        np.polynomial.legendre.legvander(at, points - 1) for at in (node, np.linspace(-1, 1, STEPS + 1))
    )
    shape = of_step @ ((of_node * weight[:, None]).T * (degree[:, None] + 0.5)) @ (vector[which, :, k] / root).T
    shape *= np.sqrt(np.abs(strength[which, k]))
    twice = np.repeat(np.arange(len(k)), np.where(orders[which] > 0, 2, 1))
    second = np.concatenate([[False], twice[1:] == twice[:-1]])
    value = np.concatenate([shape, shape[-1:]])[:, twice].astype(np.float32)
    sign = np.sign(strength[which, k])[twice].astype(np.float32)
    return Basis(value, (2 * orders[which][twice] + second).astype(np.int32), sign, float(np.abs(f).max()))


def glossy_basis(job: TransportJob, brdf: Brdf) -> Basis | None:
    """Return the functions that keep a BRDF within the accuracy's error on sample paths; None if none do."""
    generator, patches, relay = np.random.default_rng(0), job.patches, job.relay
    s, q = generator.integers(len(patches.beta), size=PROBES), generator.integers(len(relay.x_m), size=PROBES)
    spot = job.map_spots_m[generator.integers(len(job.map_spots_m), size=PROBES)]
    cell = np.stack([relay.x_m[q], relay.y_m[q], np.zeros(PROBES)], 1)
    point, normal = patches.point_m[s], patches.normal[s]
    # Legs to the dark side of a patch carry no light.
    lit = np.flatnonzero(np.all([((end - point) * normal).sum(1) > 0 for end in (spot, cell)], axis=0))
    ends_m = spot[lit], cell[lit]
    exact = scattered(brdf, ends_m[0], point[lit], normal[lit], ends_m[1])
    for points in POINTS:
        every = eigenfunctions(brdf, points)
        one, other = (_at(every, end - point[lit], normal[lit]) for end in ends_m)
        off = np.abs(np.cumsum(one * other * every.sign, 1) - exact[:, None])
        enough = off.sum(0) <= job.accuracy.scatter_error * exact.sum()
        # Errors need not fall with every term: one more than the last not good enough, and sines with their cosines.
        rank = 1 + int(np.flatnonzero(~enough).max(initial=-1)) + 1
        rank += rank < len(enough) and every.harmonic[rank] % 2
        if rank <= min(len(enough), MAX_RANK):
            first = np.ascontiguousarray(every.value[:, :rank])
            # A truncated series may exceed the BRDF by its error.
            largest = every.largest + float(off[:, rank - 1].max(initial=0))
            return Basis(first, every.harmonic[:rank], every.sign[:rank], largest)
    return None


def _at(functions: Basis, to_wall: Float64, normal: Float64) -> Float64:
    """Return the functions' values (n, R) for directions (n, 3) from patches with normals (n, 3)."""
    out = np.empty((len(normal), len(functions.sign)), np.float32)
    _fill(functions, to_wall.astype(np.float32), normal.astype(np.float32), out)
    return out.astype(np.float64)


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _evaluate(
    functions: Basis, dx: np.float32, dy: np.float32, dz: np.float32, nx: np.float32, ny: np.float32, nz: np.float32,
    harmonics: Float32, out: Float32,
) -> None:  # fmt: skip
    """Fill in the functions' values for the direction (dx, dy, dz) from a patch with that normal (nz <= 0)."""
    one, tiny = np.float32(1), np.float32(1e-20)
    inverse = one / np.sqrt(max(dx * dx + dy * dy + dz * dz, tiny))
    cosine = (dx * nx + dy * ny + dz * nz) * inverse
    # Tangents of the frame that the smallest rotation turns from the wall's: continuous for every normal with nz < 1.
    share = (dx * nx + dy * ny) / (one - nz)
    across, along = (dx + nx * dz - nx * share) * inverse, (dy + ny * dz - ny * share) * inverse
    length = np.sqrt(max(across * across + along * along, tiny))
    turn_x, turn_y = across / length, along / length
    harmonics[0], harmonics[1] = one, np.float32(0)
    for m in range(2, len(harmonics), 2):  # cos and sin of m phi by the addition theorem
        harmonics[m] = harmonics[m - 2] * turn_x - harmonics[m - 1] * turn_y
        harmonics[m + 1] = harmonics[m - 1] * turn_x + harmonics[m - 2] * turn_y
    at = np.sqrt(min(max(one - cosine, np.float32(0)), one)) * np.float32(STEPS)
    step = int(at)
    ahead = at - np.float32(step)
    low, high = functions.value[step], functions.value[step + 1]
    for r in range(len(out)):
        out[r] = (low[r] + ahead * (high[r] - low[r])) * harmonics[np.uint32(functions.harmonic[r])]


@numba.njit(cache=True)
def _fill(functions: Basis, to_wall: Float32, normal: Float32, out: Float32) -> None:
    harmonics = np.zeros(2 + functions.harmonic.max() // 2 * 2, np.float32)
    for i in range(len(out)):
        x, y, z = to_wall[i]
        nx, ny, nz = normal[i]
        _evaluate(functions, x, y, z, nx, ny, nz, harmonics, out[i])


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _patch_rows(
    s: int, surface: NumbaSurface, relay: NumbaPoints, optics: NumbaOptics, field: HeightField, functions: Basis,
    start: np.float32, per_bin: int, rows: Float32,
) -> None:  # fmt: skip
    """Fill in the tables (per_bin, R, WINDOW + width) of one patch, from the sub-bin `start` on."""
    rank, width, legs = rows.shape[1], rows.shape[2] - WINDOW, scratch(relay.tile)
    harmonics = np.zeros(2 + functions.harmonic.max() // 2 * 2, np.float32)
    values, total = np.empty(rank, np.float32), np.zeros((width * per_bin + 1, rank))
    x, y, z = surface.x_m[s], surface.y_m[s], surface.z_m[s]
    nx, ny, nz = surface.normal_x[s], surface.normal_y[s], surface.normal_z[s]
    verdicts = judge(s, s + 1, surface, relay.bounds_m, optics, field)[0]
    for tile in range(len(verdicts)):
        count = returns(verdicts[tile], legs, s, tile * relay.tile, surface, relay, optics, field)
        for i in range(count):
            at, weight, q = int(legs.length_m[i] - start), legs.weight[i], tile * relay.tile + i
            if weight > 0 and at < width * per_bin:
                _evaluate(functions, relay.x_m[q] - x, relay.y_m[q] - y, -z, nx, ny, nz, harmonics, values)
                line = total[at + 1]
                for r in range(rank):
                    line[r] += weight * values[r]
    for k in range(width * per_bin):
        for r in range(rank):
            total[k + 1, r] += total[k, r]
    for shift in range(per_bin):
        for i in range(width):
            until, begin = total[(i + 1) * per_bin - shift], total[max(i * per_bin - shift, 0)]
            for r in range(rank):
                rows[shift, r, WINDOW + i] = np.float32(until[r] - begin[r]) * functions.sign[r]


@numba.njit(cache=True, parallel=True)
def _rows(
    begin: int, surface: NumbaSurface, relay: NumbaPoints, optics: NumbaOptics, field: HeightField, functions: Basis,
    first: NDArray[np.int32], per_bin: int, rows: Float32,
) -> None:  # fmt: skip
    """Fill in the tables (patches, per_bin, R, WINDOW + width) of some patches: B times each function, as sums to bins.

    Light beyond the width is left out.
    """
    for j in numba.prange(len(rows)):
        s = begin + j
        start = np.float32(first[s] * per_bin)
        _patch_rows(s, surface, relay, optics, field, functions, start, per_bin, rows[j])


@numba.njit(cache=True, parallel=True)
def _begins(
    feet: NumbaPoints, groups: NumbaGroups, centers: NumbaSurface, optics: NumbaOptics, table: NumbaTables
) -> tuple[Float32, int]:
    """Return a bin (n,) before every path of each beam, and the bins from there to the last path of any."""
    beams = len(feet.x_m)
    tiles = (beams + BEAM_TILE - 1) // BEAM_TILE
    begin, bins = np.zeros(beams, np.float32), np.zeros(tiles, np.int64)
    for tile in numba.prange(tiles):
        start = tile * BEAM_TILE
        near, bins[tile] = ends(start, min(BEAM_TILE, beams - start), feet, groups, centers, optics, table)
        for i in range(len(near)):
            begin[start + i] = near[i]
    return begin, bins.max()


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_tile(
    start: int, size: int, patch: int, feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics,
    field: HeightField, functions: Basis, table: NumbaTables, begin: Float32, rows: Float32, sums: Float32,
    bound: Float32,
) -> None:  # fmt: skip
    """Add the tables of the patches from one on to the windows of some beams, and to their bounds."""
    bins, per_bin, rank, span = sums.shape[1], table.per_bin, rows.shape[2], rows.shape[3]
    flat, every, width = rows.ravel(), sums.ravel(), span - WINDOW
    tile = feet.bounds_m[start // BEAM_TILE : start // BEAM_TILE + 1]
    verdicts = judge(patch, patch + len(rows), surface, tile, optics, field)
    legs, harmonics = scratch(size), np.zeros(2 + functions.harmonic.max() // 2 * 2, np.float32)
    weight, offset, base = np.empty(rank, np.float32), np.empty(rank, np.int32), np.arange(rank) * span
    for j in range(len(rows)):
        s = patch + j
        if verdicts[j, 0] == DARK:
            continue
        fill(legs, s, surface, feet, start, size, verdicts[j, 0], optics, field, False)
        x, y, z = surface.x_m[s], surface.y_m[s], surface.z_m[s]
        nx, ny, nz = surface.normal_x[s], surface.normal_y[s], surface.normal_z[s]
        for i in range(size):
            light = legs.weight[i] * surface.strength[s]
            if light == 0:
                continue
            at = int(np.floor((legs.length_m[i] + feet.length_m[start + i]) * optics.inverse_bin + np.float32(0.5)))
            ahead = int(begin[start + i]) - at // per_bin - table.first[s]
            bound[start + i] += light * table.rest[s, min(max(ahead + bins, 0), table.width)]
            if ahead + bins <= 0:
                continue
            _evaluate(functions, feet.x_m[start + i] - x, feet.y_m[start + i] - y, -z, nx, ny, nz, harmonics, weight)
            for r in range(rank):
                weight[r] *= light
            origin = (j * per_bin + at % per_bin) * rank * span + WINDOW
            for window in range(0, bins, WINDOW):
                if -WINDOW < ahead + window < width:
                    for r in range(rank):
                        offset[r] = origin + ahead + window
                    add_rows(every, (start + i) * bins + window, flat, base, offset, weight, 0, 1, rank)


@numba.njit(cache=True, parallel=True)
def _add(
    patch: int, feet: NumbaPoints, surface: NumbaSurface, optics: NumbaOptics, field: HeightField, functions: Basis,
    table: NumbaTables, begin: Float32, rows: Float32, sums: Float32, bound: Float32,
) -> None:  # fmt: skip
    """Add the tables of the patches from one on to the beams' windows, and to each beam's bound on all later bins."""
    beams = len(feet.x_m)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        size = min(BEAM_TILE, beams - start)
        _add_tile(start, size, patch, feet, surface, optics, field, functions, table, begin, rows, sums, bound)


def _sums(
    numba_job: NumbaJob, feet: NumbaPoints, table: NumbaTables, functions: Basis, *, first_only: bool
) -> tuple[Int64, Float32, Float32]:
    """Return the bin (n,) at which each beam's window begins, its sums (n, bins), and a bound (n,) on later bins."""
    surface, groups, centers, optics, field = numba_job.sites
    begin, bins = _begins(feet, groups, centers, optics, table)
    # No path of a patch begins before the window, so that its first bins hold all that the first window can meet.
    windows = 1 if first_only else -(-bins // WINDOW)
    span, rank = WINDOW + (WINDOW + 8 if first_only else table.width), len(functions.sign)
    sums, bound = np.zeros((len(begin), windows * WINDOW), np.float32), np.zeros(len(begin), np.float32)
    patches, threads = len(surface.x_m), numba.get_num_threads()
    block = max(TABLE_BYTES // (4 * table.per_bin * rank * span), threads)
    for patch in range(0, patches, block):
        # A row is read up to a window beyond its end: into the next one's zeros, or those after the last.
        flat = np.zeros(min(block, patches - patch) * table.per_bin * rank * span + WINDOW, np.float32)
        rows = flat[:-WINDOW].reshape(-1, table.per_bin, rank, span)
        _rows(patch, surface, numba_job.relay, optics, field, functions, table.first, table.per_bin, rows)
        _add(patch, feet, surface, optics, field, functions, table, begin, rows, sums, bound)
    # A truncated series may fall below 0 by its error where there is no light.
    begin, sums, bound = begin[feet.place], sums[feet.place], bound[feet.place]
    return begin.astype(np.int64), np.maximum(sums, 0), bound * np.float32(functions.largest)


def _histograms(numba_job: NumbaJob, functions: Basis, which: Any = slice(None)) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for some of the job's beams."""
    job, table = numba_job.job, numba_job.tables(np.empty((0, 0), np.float32))
    share = np.zeros(len(job.laser_spot_m))
    share[which] = 1
    begin, sums, _ = _sums(numba_job, numba_job.feet(share), table, functions, first_only=False)
    found = np.zeros((len(begin), job.bins), np.float32)
    at = begin[:, None] + np.arange(sums.shape[1])
    beam, k = np.nonzero((at >= 0) & (at < job.bins))
    found[beam, at[beam, k]] = sums[beam, k]
    return found


def _echoes(numba_job: NumbaJob, functions: Basis) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `_histograms`, bit for bit, for less work."""
    job, table = numba_job.job, numba_job.tables(np.empty((0, 0), np.float32))
    begin, sums, bound = _sums(
        numba_job, numba_job.feet(np.ones(len(job.laser_spot_m))), table, functions, first_only=True
    )
    at = begin[:, None] + np.arange(WINDOW)
    found = strongest(np.where((at >= 0) & (at < job.bins), sums, 0), job.bin_m)
    found.path_m[:] = ((found.path_m / job.bin_m - 0.5).round() + begin + 0.5) * job.bin_m
    if (unsure := np.flatnonzero(bound * ROUNDED > found.runner_up)).size:
        rest = strongest(_histograms(numba_job, functions, unsure), job.bin_m)
        found.peak[unsure], found.runner_up[unsure], found.path_m[unsure] = rest.peak, rest.runner_up, rest.path_m
    return found


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the beams of a job with any BRDF or none.

    A BRDF without few eigenfunctions has a table for each of some directions of incoming light instead.
    """
    if job.brdf is None:
        return backend_numba.histograms(job)
    numba_job = NumbaJob(job)
    if not job.more_bounces and (functions := glossy_basis(job, job.brdf)) is not None:
        return _histograms(numba_job, functions)
    total = np.zeros((len(job.laser_spot_m), job.bins), np.float32)
    for foot, share in nodes(job, job.brdf):
        factor = scattering(job.brdf)(foot, job.patches.point_m, job.patches.normal, job.relay.x_m, job.relay.y_m)
        total += numba_job.histograms(factor.astype(np.float32), share)
    return total


def echoes(job: TransportJob) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `histograms`, bit for bit, from a part of its work.

    A BRDF without few eigenfunctions needs whole histograms.
    """
    if job.brdf is None:
        return backend_numba.echoes(job)
    functions = None if job.more_bounces else glossy_basis(job, job.brdf)
    return _echoes(NumbaJob(job), functions) if functions else strongest(histograms(job), job.bin_m)
