"""Glossy surfaces on the CPU: a BRDF as a sum of products, each of a function of one leg and the
same of the other.

An isotropic, reciprocal BRDF is a symmetric function of two directions, so it has eigenfunctions on
the hemisphere about the normal: f(in, out) = sum_r l_r e_r(in) e_r(out), with e_r = g_r(x) cos(m
phi) or g_r(x) sin(m phi) and x = sqrt(1 - cosine). S2 then factorizes again, once for each r: a
patch has a table of B e_r for every r, and a beam adds them all with the weights l_r e_r. Many
directions never occur, so the functions are mixed anew to be the eigenfunctions for the directions
of sample paths, which takes half as many for the same error. They are looked up on a grid.
Reciprocity is exact, whatever the number of terms and the grid.
"""

from functools import lru_cache
from typing import Any, NamedTuple, Self

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

STAGES = (48, 128), (48, 2048), (96, 2048), (192, 2048)
"""Gauss points of x, and functions at most, in the order in which they are tried."""
STEPS = 512
"""Steps of x in the table of the functions."""
GRID_BYTES = 1 << 28
"""Limit of the memory for a grid of directions."""
SIDES = 32, 48, 64, 96, 128, 192, 256, 384
"""Points along a side of the grid of directions, in the order in which they are tried."""
PROBES = 2048
"""Sample paths on which the error is measured."""
PATHS = 32
PATHS_AT_MOST = 1 << 14
"""Other sample paths for each function, for whose directions they are mixed: with fewer a lobe is
learnt by heart.
"""
TABLE_BYTES = 1 << 20
"""Memory for the tables of the patches whose rows are added together: the second cache."""


class Eigenfunctions(NamedTuple):
    """Functions of one direction (R) about the normal, of an eigenfunction with m > 0 two."""

    value: Float64
    """(STEPS + 2, R); sqrt |l| g(x), the last row a copy for the upper end."""
    harmonic: NDArray[np.int64]
    """(R,); 2 m for cos(m phi), 2 m + 1 for sin(m phi)."""
    sign: Float64
    """(R,); of l."""

    def first(self, count: int) -> Self:
        """Return the largest functions alone."""
        return self._replace(
            value=self.value[:, :count], harmonic=self.harmonic[:count], sign=self.sign[:count]
        )


class Basis(NamedTuple):
    """Functions of one direction (R) on a grid of the disc of x (cos phi, sin phi), from -1 to
    1.
    """

    value: Float32
    """(side, side, R)."""
    sign: Float32
    """(R,)."""


@lru_cache(maxsize=8)
def eigenfunctions(brdf: Brdf, points: int) -> Eigenfunctions:
    """Return the functions of a BRDF, the largest |l| first, from a grid of `points` x and twice as
    many angles.
    """
    node, weight = np.polynomial.legendre.leggauss(points)
    x = (node + 1) / 2
    turn = np.arange(points + 1) * np.pi / points
    cosine = 1 - x**2
    sine = np.sqrt(1 - cosine**2)
    across = sine[:, None, None] * sine[None, :, None]
    along = cosine[:, None, None] * cosine[None, :, None]
    f = brdf(
        cosine[:, None, None], cosine[None, :, None], along + across * np.cos(turn)
    ) + np.zeros_like(across * turn)
    # Fourier series in the angle between the azimuths, even: f = sum_m f_m(x, x') cos(m turn).
    series = np.fft.rfft(np.concatenate([f, f[..., -2:0:-1]], -1)).real / points
    series[..., 0] /= 2
    orders = np.flatnonzero(np.abs(series[..., :points]).max((0, 1)) > 1e-7 * np.abs(f).max())
    # The solid angle of a ring is 2 pi sin dtheta = 4 pi x dx: its root on both sides keeps the
    # matrix symmetric.
    root = np.sqrt(weight * x)
    strength, vector = np.linalg.eigh(
        np.moveaxis(series[..., orders], -1, 0) * root * root[:, None]
    )
    which, k = np.nonzero(np.abs(strength) > 1e-7 * np.abs(strength).max())
    order = np.argsort(-np.abs(strength[which, k]), kind="stable")
    which = which[order]
    k = k[order]
    # From the Gauss points to an even grid by the polynomial through them, which Gauss quadrature
    # gives in Legendre's.
    degree = np.arange(points)
    of_node, of_step = (
        np.polynomial.legendre.legvander(at, points - 1)
        for at in (node, np.linspace(-1, 1, STEPS + 1))
    )
    shape = (
        of_step
        @ ((of_node * weight[:, None]).T * (degree[:, None] + 0.5))
        @ (vector[which, :, k] / root).T
    )
    shape *= np.sqrt(np.abs(strength[which, k]))
    twice = np.repeat(np.arange(len(k)), np.where(orders[which] > 0, 2, 1))
    second = np.concatenate([[False], twice[1:] == twice[:-1]])
    value = np.concatenate([shape, shape[-1:]])[:, twice]
    return Eigenfunctions(
        value, 2 * orders[which][twice] + second, np.sign(strength[which, k])[twice]
    )


def glossy_basis(job: TransportJob, brdf: Brdf) -> Basis | None:
    """Return the functions that keep a BRDF within the accuracy's error on sample paths; None if
    none do.
    """
    spot, point, normal, cell = _sample_paths(job, PROBES, seed=0)
    exact = scattered(brdf, spot, point, normal, cell)
    probes = [_on_disc(end - point, normal) for end in (spot, cell)]
    limit = job.accuracy.scatter_error * exact.sum()
    for points, most in STAGES:
        every = eigenfunctions(brdf, points).first(most)
        one, other = (_at(every, end) for end in probes)
        if (rank := _rank(one * other * every.sign, exact, limit / 2)) <= len(every.sign):
            mix, sign = _restricted(job, every.first(rank))
            one, other = (end[:, :rank] @ mix for end in (one, other))
            fewer = min(_rank(one * other * sign, exact, 0.8 * limit), len(sign))
            return _on_grid(every.first(rank), mix[:, :fewer], sign[:fewer], probes, exact, limit)
    return None


def _sample_paths(
    job: TransportJob, count: int, seed: int
) -> tuple[Float64, Float64, Float64, Float64]:
    """Return spots, patches' points and normals, and relay cells (n, 3) of sample paths that may
    carry light.
    """
    generator = np.random.default_rng(seed)
    patches = job.patches
    relay = job.relay
    s = generator.integers(len(patches.beta), size=count)
    q = generator.integers(len(relay.x_m), size=count)
    spot = job.map_spots_m[generator.integers(len(job.map_spots_m), size=count)]
    cell = np.stack([relay.x_m[q], relay.y_m[q], np.zeros(count)], 1)
    point = patches.point_m[s]
    normal = patches.normal[s]
    # Legs to the dark side of a patch carry no light.
    lit = np.flatnonzero(
        np.all([((end - point) * normal).sum(1) > 0 for end in (spot, cell)], axis=0)
    )
    return spot[lit], point[lit], normal[lit], cell[lit]


def _rank(terms: Float64, exact: Float64, limit: float) -> int:
    """Return how many terms (n, R) of a series are enough for a sum of errors; more than R if all
    are not.
    """
    enough = np.abs(np.cumsum(terms, 1) - exact[:, None]).sum(0) <= limit
    return (
        1 + int(np.flatnonzero(~enough).max(initial=-1)) + 1
    )  # errors need not fall with every term


def _restricted(job: TransportJob, functions: Eigenfunctions) -> tuple[Float64, Float64]:
    """Return the mix (R, R) of functions that has the fewest terms for the directions of a job, and
    their signs.

    These are the eigenfunctions of the same BRDF where a direction counts as often as it occurs: an
    object that sees the wall under half of all directions needs half of the functions.
    """
    rank = len(functions.sign)
    spot, point, normal, cell = _sample_paths(job, min(PATHS * rank, PATHS_AT_MOST), seed=1)
    products = np.zeros((rank, rank))
    for begin in range(0, len(point), PROBES):
        some = slice(begin, begin + PROBES)
        for end in (spot, cell):
            value = _at(functions, _on_disc(end[some] - point[some], normal[some]))
            products += value.T @ value
    spread, axes = np.linalg.eigh(products)
    root = axes * np.sqrt(np.maximum(spread, 0))
    strength, vector = np.linalg.eigh((root.T * functions.sign) @ root)
    some = np.abs(strength) > 1e-9 * np.abs(strength).max()
    order = np.flatnonzero(some)[np.argsort(-np.abs(strength[some]), kind="stable")]
    mix = (functions.sign[:, None] * root) @ vector[:, order] / np.sqrt(np.abs(strength[order]))
    # Their last digits may differ between calls (test_repeatable saw it): rounded, a scene keeps
    # its functions.
    return mix.astype(np.float32).astype(np.float64), np.sign(strength[order])


def _on_grid(
    functions: Eigenfunctions,
    mix: Float64,
    sign: Float64,
    ends: list[Float64],
    exact: Float64,
    limit: float,
) -> Basis | None:
    """Return mixed functions on the coarsest grid that keeps the sum of errors of paths; None if
    none does.
    """
    for side in SIDES:
        if 4 * side**2 * len(sign) > GRID_BYTES:
            break
        axis = np.linspace(-1, 1, side)
        lines = (np.stack([np.full(side, x), axis], -1) for x in axis)
        value = np.stack([(_at(functions, line) @ mix).astype(np.float32) for line in lines])
        # Between points that are a step h apart, straight lines lie h^2 / 12 f'' above a function,
        # on average.
        bent = [
            np.diff(value, 2, axis, value.take([0], axis), value.take([-1], axis))
            for axis in (0, 1)
        ]
        basis = Basis(
            (value - (bent[0] + bent[1]) / 12).astype(np.float32), sign.astype(np.float32)
        )
        one, other = (_looked_up(basis, end) for end in ends)
        if np.abs((one * other * sign).sum(1) - exact).sum() <= limit:
            return basis
    return None


def _on_disc(to_wall: Float64, normal: Float64) -> Float64:
    """Return directions (n, 3) from patches with normals (n, 3) as x (cos phi, sin phi) (n, 2)."""
    disc = np.empty((len(normal), 2), np.float32)
    _fill_discs(to_wall.astype(np.float32), normal.astype(np.float32), disc)
    return disc.astype(np.float64)


@numba.njit(cache=True)
def _fill_discs(to_wall: Float32, normal: Float32, disc: Float32) -> None:
    for i in range(len(normal)):
        disc[i] = _disc(
            to_wall[i, 0], to_wall[i, 1], to_wall[i, 2], normal[i, 0], normal[i, 1], normal[i, 2]
        )


def _at(functions: Eigenfunctions, disc: Float64) -> Float64:
    """Return the functions' values (n, R) at points (n, 2) of the disc, or beyond its edge at the
    edge.
    """
    at = np.minimum(np.hypot(*disc.T), 1) * STEPS
    step = at.astype(np.int64)
    turn = np.arctan2(disc[:, 1], disc[:, 0])
    low = functions.value[step]
    high = functions.value[step + 1]
    angle = turn[:, None] * np.arange(functions.harmonic.max() // 2 + 1)
    around = np.stack([np.cos(angle), np.sin(angle)], -1).reshape(len(disc), -1)
    return (low + (at - step)[:, None] * (high - low)) * around[:, functions.harmonic]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _disc(
    dx: np.float32, dy: np.float32, dz: np.float32, nx: np.float32, ny: np.float32, nz: np.float32
) -> tuple[np.float32, np.float32]:
    """Return the direction (dx, dy, dz) from a patch with that normal (nz <= 0) as x (cos phi, sin
    phi).
    """
    one = np.float32(1)
    tiny = np.float32(1e-20)
    inverse = one / np.sqrt(max(dx * dx + dy * dy + dz * dz, tiny))
    cosine = max((dx * nx + dy * ny + dz * nz) * inverse, np.float32(0))
    # Tangents of the frame that the smallest rotation turns from the wall's: continuous for every
    # normal with nz < 1.
    share = (dx * nx + dy * ny) / (one - nz)
    scale = inverse / np.sqrt(one + cosine)  # sine^2 = (1 - cosine) (1 + cosine) = x^2 (1 + cosine)
    return (dx + nx * dz - nx * share) * scale, (dy + ny * dz - ny * share) * scale


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _values(
    functions: Basis, x: np.float32, y: np.float32, light: np.float32, out: Float32
) -> np.float32:
    """Fill in the functions' values at a point of the disc, times light; return the sum of their
    squares.
    """
    last = len(functions.value) - 2
    rank = len(out)
    half = np.float32(0.5)
    one = np.float32(1)
    squares = np.float32(0)
    at_x = (x * half + half) * np.float32(last + 1)
    at_y = (y * half + half) * np.float32(last + 1)
    i = min(max(int(at_x), 0), last)
    j = min(max(int(at_y), 0), last)
    x = min(max(at_x - np.float32(i), np.float32(0)), one)
    y = min(max(at_y - np.float32(j), np.float32(0)), one)
    near = (one - x) * light
    far = x * light
    near_low = near * (one - y)
    near_high = near * y
    far_low = far * (one - y)
    far_high = far * y
    one_row = functions.value[i]
    next_row = functions.value[i + 1]
    a = one_row[j]
    b = one_row[j + 1]
    c = next_row[j]
    d = next_row[j + 1]
    for r in range(rank):
        value = near_low * a[r] + near_high * b[r] + far_low * c[r] + far_high * d[r]
        out[r] = value
        squares += value * value
    return squares


@numba.njit(cache=True)
def _fill(functions: Basis, disc: Float32, out: Float32) -> None:
    for i in range(len(out)):
        _values(functions, disc[i, 0], disc[i, 1], np.float32(1), out[i])


def _looked_up(functions: Basis, disc: Float64) -> Float64:
    """Return the values (n, R) at points (n, 2) of the disc, as the sums take them."""
    out = np.zeros((len(disc), len(functions.sign)), np.float32)
    _fill(functions, disc.astype(np.float32), out)
    return out.astype(np.float64)


@numba.njit(cache=True, error_model="numpy")
def _discs(
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    start: int,
    count: int,
    disc_x: Float32,
    disc_y: Float32,
) -> None:
    """Fill in where the legs from a patch to points of the wall meet its disc, vector by vector.

    Without leave to contract products and sums, so that a leg's last bit does not depend on its
    place in the vectors.
    """
    x = surface.x_m[s]
    y = surface.y_m[s]
    z = surface.z_m[s]
    nx = surface.normal_x[s]
    ny = surface.normal_y[s]
    nz = surface.normal_z[s]
    at_x = points.x_m[start : start + count]
    at_y = points.y_m[start : start + count]
    for i in range(count):
        disc_x[i], disc_y[i] = _disc(at_x[i] - x, at_y[i] - y, -z, nx, ny, nz)


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _as_rows(counted: Float32, sign: Float32, rows: Float32, rest: Float32) -> None:
    """Fill in rows, and norms from a bin on, from light in sub-bins (bins * per_bin, R), times each
    function.
    """
    per_bin = rows.shape[0]
    rank = rows.shape[1]
    width = rows.shape[2] - WINDOW
    bins = len(rest) - 1
    total = np.zeros(
        (len(counted) + 1, rank)
    )  # float64, so that the difference of large sums keeps the small bins
    for k in range(len(counted)):
        for r in range(rank):
            total[k + 1, r] = total[k, r] + counted[k, r]
    for shift in range(per_bin):
        for i in range(bins):
            until = total[(i + 1) * per_bin - shift]
            begin = total[max(i * per_bin - shift, 0)]
            squares = 0.0
            for r in range(rank):
                squares += (until[r] - begin[r]) ** 2
            rest[i] = max(rest[i], np.float32(np.sqrt(squares)))
            if i < width:
                for r in range(rank):
                    rows[shift, r, WINDOW + i] = np.float32(until[r] - begin[r]) * sign[r]
    for i in range(bins - 1, -1, -1):
        rest[i] = max(rest[i], rest[i + 1])


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _patch_rows(
    s: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    functions: Basis,
    start: np.float32,
    per_bin: int,
    rows: Float32,
    rest: Float32,
) -> None:
    """Fill in the tables (per_bin, R, WINDOW + width) of one patch, from the sub-bin `start` on.

    `rest` (bins + 1) is the largest norm over all functions, of any shift, from a bin on.
    """
    bins = len(rest) - 1
    legs = scratch(relay.tile)
    counted = np.zeros((bins * per_bin, rows.shape[1]), np.float32)
    value = np.empty(rows.shape[1], np.float32)
    verdicts = judge(s, s + 1, surface, relay.bounds_m, optics, field)[0]
    disc_x = np.empty(relay.tile, np.float32)
    disc_y = np.empty(relay.tile, np.float32)
    for tile in range(len(verdicts)):
        count = returns(verdicts[tile], legs, s, tile * relay.tile, surface, relay, optics, field)
        _discs(s, surface, relay, tile * relay.tile, count, disc_x, disc_y)
        for i in range(count):
            at = int(legs.length_m[i] - start)
            if legs.weight[i] > 0 and at < bins * per_bin:
                _values(functions, disc_x[i], disc_y[i], legs.weight[i], value)
                line = counted[at]
                for r in range(len(value)):
                    line[r] += value[r]
    _as_rows(counted, functions.sign, rows, rest)


@numba.njit(cache=True, parallel=True)
def _rows(
    begin: int,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    functions: Basis,
    table: NumbaTables,
    rows: Float32,
) -> None:
    """Fill in the tables (patches, per_bin, R, WINDOW + width) of some patches: B times each
    function, as sums to bins.

    Light beyond the width is in `table.rest` alone.
    """
    for j in numba.prange(len(rows)):
        s = begin + j
        per_bin = table.per_bin
        start = np.float32(table.first[s] * per_bin)
        _patch_rows(
            s, surface, relay, optics, field, functions, start, per_bin, rows[j], table.rest[s]
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


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _add_tile(
    start: int,
    size: int,
    patch: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    functions: Basis,
    table: NumbaTables,
    begin: Float32,
    rows: Float32,
    sums: Float32,
    bound: Float32,
) -> None:
    """Add the tables of the patches from one on to the windows of some beams, and to their
    bounds.
    """
    bins = sums.shape[1]
    per_bin = table.per_bin
    rank = rows.shape[2]
    span = rows.shape[3]
    flat = rows.ravel()
    every = sums.ravel()
    width = span - WINDOW
    tile = feet.bounds_m[start // BEAM_TILE : start // BEAM_TILE + 1]
    verdicts = judge(patch, patch + len(rows), surface, tile, optics, field)
    legs = scratch(size)
    at = np.empty(size, np.int32)
    shift = np.empty(size, np.int32)
    disc_x = np.empty(size, np.float32)
    disc_y = np.empty(size, np.float32)
    weight = np.empty(rank, np.float32)
    offset = np.empty(rank, np.int32)
    base = np.arange(rank) * span
    for j in range(len(rows)):
        s = patch + j
        if verdicts[j, 0] == DARK:
            continue
        fill(legs, s, surface, feet, start, size, verdicts[j, 0], optics, field, False)
        _discs(s, surface, feet, start, size, disc_x, disc_y)
        for i in range(size):
            at[i] = np.int32(
                (legs.length_m[i] + feet.length_m[start + i]) * optics.inverse_bin + np.float32(0.5)
            )
            shift[i] = at[i] % np.int32(per_bin)
        # Beams of one shift go together: their rows stay in the first cache.
        for now in range(per_bin):
            origin = (j * per_bin + now) * rank * span + WINDOW
            for i in range(size):
                if shift[i] != now or legs.weight[i] == 0:
                    continue
                ahead = int(begin[start + i]) - at[i] // per_bin - table.first[s]
                light = legs.weight[i]
                squares = _values(
                    functions, disc_x[i], disc_y[i], light * surface.strength[s], weight
                )
                # A sum of products is at most the product of both norms (Cauchy and Schwarz).
                bound[start + i] += (
                    np.sqrt(squares) * table.rest[s, min(max(ahead + bins, 0), table.width)]
                )
                for window in range(0, bins, WINDOW):
                    if -WINDOW < ahead + window < width:
                        offset[:] = origin + ahead + window
                        add_rows(
                            every,
                            (start + i) * bins + window,
                            flat,
                            base,
                            offset,
                            weight,
                            0,
                            1,
                            rank,
                        )


@numba.njit(cache=True, parallel=True)
def _add(
    patch: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
    functions: Basis,
    table: NumbaTables,
    begin: Float32,
    rows: Float32,
    sums: Float32,
    bound: Float32,
) -> None:
    """Add the tables of the patches from one on to the beams' windows, and to each beam's bound on
    all later bins.
    """
    beams = len(feet.x_m)
    for tile in numba.prange((beams + BEAM_TILE - 1) // BEAM_TILE):
        start = tile * BEAM_TILE
        size = min(BEAM_TILE, beams - start)
        _add_tile(
            start,
            size,
            patch,
            feet,
            surface,
            optics,
            field,
            functions,
            table,
            begin,
            rows,
            sums,
            bound,
        )


def _sums(
    numba_job: NumbaJob, feet: NumbaPoints, functions: Basis, *, first_only: bool
) -> tuple[Int64, Float32, Float32]:
    """Return the bin (n,) at which each beam's window begins, its sums (n, bins), and a bound (n,)
    on later bins.
    """
    surface, groups, centers, optics, field = numba_job.sites
    rest = np.zeros((len(surface.x_m), numba_job.width + 1), np.float32)
    per_bin = numba_job.job.accuracy.sub_bins
    table = NumbaTables(numba_job.first, np.empty(0, np.float32), rest, per_bin, numba_job.width)
    begin, bins = _begins(feet, groups, centers, optics, table)
    # No path of a patch begins before the window, so that its first bins hold all that the first
    # window can meet.
    windows = 1 if first_only else -(-bins // WINDOW)
    span = WINDOW + (WINDOW + 8 if first_only else table.width)
    rank = len(functions.sign)
    sums = np.zeros((len(begin), windows * WINDOW), np.float32)
    bound = np.zeros(len(begin), np.float32)
    patches = len(surface.x_m)
    threads = numba.get_num_threads()
    block = max(TABLE_BYTES // (4 * table.per_bin * rank * span), threads)
    for patch in range(0, patches, block):
        # A row is read up to a window beyond its end: into the next one's zeros, or those after the
        # last.
        flat = np.zeros(
            min(block, patches - patch) * table.per_bin * rank * span + WINDOW, np.float32
        )
        rows = flat[:-WINDOW].reshape(-1, table.per_bin, rank, span)
        _rows(patch, surface, numba_job.relay, optics, field, functions, table, rows)
        _add(patch, feet, surface, optics, field, functions, table, begin, rows, sums, bound)
    # A truncated series may fall below 0 by its error where there is no light.
    begin = begin[feet.place]
    sums = sums[feet.place]
    bound = bound[feet.place]
    return begin.astype(np.int64), np.maximum(sums, 0), bound


def _histograms(numba_job: NumbaJob, functions: Basis, which: Any = slice(None)) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for some of the job's beams."""
    job = numba_job.job
    share = np.zeros(len(job.laser_spot_m))
    share[which] = 1
    begin, sums, _ = _sums(numba_job, numba_job.feet(share), functions, first_only=False)
    found = np.zeros((len(begin), job.bins), np.float32)
    at = begin[:, None] + np.arange(sums.shape[1])
    beam, k = np.nonzero((at >= 0) & (at < job.bins))
    found[beam, at[beam, k]] = sums[beam, k]
    return found


def _echoes(numba_job: NumbaJob, functions: Basis) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `_histograms`, bit for bit, for
    less work.
    """
    job = numba_job.job
    begin, sums, bound = _sums(
        numba_job, numba_job.feet(np.ones(len(job.laser_spot_m))), functions, first_only=True
    )
    at = begin[:, None] + np.arange(WINDOW)
    found = strongest(np.where((at >= 0) & (at < job.bins), sums, 0), job.bin_m)
    found.path_m[:] = ((found.path_m / job.bin_m - 0.5).round() + begin + 0.5) * job.bin_m
    if (unsure := np.flatnonzero(bound * ROUNDED > found.runner_up)).size:
        rest = strongest(_histograms(numba_job, functions, unsure), job.bin_m)
        found.peak[unsure] = rest.peak
        found.runner_up[unsure] = rest.runner_up
        found.path_m[unsure] = rest.path_m
    return found


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the beams of a job with any BRDF
    or none.

    A BRDF without few eigenfunctions has a table for each of some directions of incoming light
    instead.
    """
    if job.brdf is None:
        return backend_numba.histograms(job)
    numba_job = NumbaJob(job)
    if not job.more_bounces and (functions := glossy_basis(job, job.brdf)) is not None:
        return _histograms(numba_job, functions)
    total = np.zeros((len(job.laser_spot_m), job.bins), np.float32)
    for foot, share in nodes(job, job.brdf):
        factor = scattering(job.brdf)(
            foot, job.patches.point_m, job.patches.normal, job.relay.x_m, job.relay.y_m
        )
        total += numba_job.histograms(factor.astype(np.float32), share)
    return total


def echoes(job: TransportJob) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `histograms`, bit for bit, from a
    part of its work.

    A BRDF without few eigenfunctions needs whole histograms.
    """
    if job.brdf is None:
        return backend_numba.echoes(job)
    functions = None if job.more_bounces else glossy_basis(job, job.brdf)
    return _echoes(NumbaJob(job), functions) if functions else strongest(histograms(job), job.bin_m)
