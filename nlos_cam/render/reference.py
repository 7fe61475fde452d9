"""The renderer that defines the others: every three-bounce path by itself, in float64 (S2 to S4).

Slow on purpose (it is compiled, and still takes a minute or two for a whole map): each line is an equation.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.render.job import Job
from nlos_cam.render.near import softened
from nlos_cam.render.reference_between import more_paths
from nlos_cam.render.scatter import scattering
from nlos_cam.render.visibility import HeightField, occluded, visible

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

BEAM_GROUP = 256
"""Beams summed in one compiled call."""


@numba.njit(cache=True, parallel=True)
def legs(
    points: Array,
    normals: Array,
    rows: Index,
    columns: Index,
    x: Array,
    y: Array,
    edge_x: float,
    edge_z: float,
    field: HeightField,
) -> Mask:
    """V (n, m) of the legs between patches and points of the wall: lit side, occluder, the object itself."""
    table = np.zeros((len(points), len(x)), np.bool_)
    for s in numba.prange(len(points)):
        point, normal = points[s], normals[s]
        for w in range(len(x)):
            facing = normal[0] * (x[w] - point[0]) + normal[1] * (y[w] - point[1]) - normal[2] * point[2]
            if facing > 0 and not occluded(point[0], point[2], x[w], 0.0, edge_x, edge_z):
                table[s, w] = visible(field, rows[s], columns[s], point, x[w], y[w])
    return table


@numba.njit(cache=True, error_model="numpy")
def _taken(
    foot: Array, normal: Array, point: Array, strength: float, soft: float, near_m: float, lambertian: bool
) -> float:
    """What of S2 the way from a beam's foot to a patch makes: the light that the patch gives on."""
    to_foot = foot - point
    d2 = np.sqrt((to_foot**2).sum())
    cos_2 = (normal * to_foot).sum() / d2
    taken = strength * cos_2 / softened(d2**2, soft, near_m)
    return taken * point[2] / d2 if lambertian else taken  # leaving the wall


@numba.njit(cache=True, error_model="numpy")
def _given(
    dx: float, dy: float, z: float, facing: float, relay_weight: float, soft: float, near_m: float, lambertian: bool
) -> tuple[float, float]:
    """What of S2 the way from a patch over a relay cell to the lidar makes; and d3.

    The cell is (dx, dy, -z) away, which times the patch's normal is `facing`.
    """
    squared = dx**2 + dy**2 + z**2
    d3 = np.sqrt(squared)
    given = relay_weight * (z / d3) / softened(squared, soft, near_m)  # cos t3
    return (given * facing / d3 if lambertian else given), d3


@numba.njit(cache=True, parallel=True)
def _paths(
    foot: Array,
    d1: Array,
    beam_weight: Array,
    lit: Mask,
    points: Array,
    normals: Array,
    strength: Array,
    soft_patch: Array,
    x: Array,
    y: Array,
    d4: Array,
    relay_weight: Array,
    soft_wall: float,
    seen: Mask,
    factor: Array,
    near_m: float,
    lambertian: bool,
    bin_m: float,
    bins: int,
) -> Array:
    histogram = np.zeros((len(foot), bins))
    for p in numba.prange(len(foot)):
        for s in range(len(points)):
            if not lit[s, p]:
                continue
            a = beam_weight[p] * _taken(foot[p], normals[s], points[s], strength[s], soft_patch[s], near_m, lambertian)
            d2 = np.sqrt(((foot[p] - points[s]) ** 2).sum())
            px, py, pz = points[s]
            nx, ny, nz = normals[s]
            for q in range(len(x)):
                if not seen[s, q]:
                    continue
                dx, dy = x[q] - px, y[q] - py
                facing = nx * dx + ny * dy - nz * pz
                b, d3 = _given(dx, dy, pz, facing, relay_weight[q], soft_wall, near_m, lambertian)
                if factor.size:
                    b *= factor[s, q]
                k = int(np.floor((d1[p] + d2 + d3 + d4[q]) / bin_m))  # S4
                if k < bins:
                    histogram[p, k] += a * b  # S2
    return histogram


@numba.njit(cache=True)
def _ends(
    foot: Array,
    beam_weight: Array,
    lit: Mask,
    points: Array,
    normals: Array,
    strength: Array,
    soft_patch: Array,
    x: Array,
    y: Array,
    relay_weight: Array,
    soft_wall: float,
    seen: Mask,
    near_m: float,
    lambertian: bool,
) -> tuple[Array, Array]:
    """Both ends of every path: taken (beams, patches) and given (patches, cells)."""
    taken, given = np.zeros((len(foot), len(points))), np.zeros((len(points), len(x)))
    for s in range(len(points)):
        for p in range(len(foot)):
            if lit[s, p]:
                taken[p, s] = beam_weight[p] * _taken(
                    foot[p], normals[s], points[s], strength[s], soft_patch[s], near_m, lambertian
                )
        for q in range(len(x)):
            if seen[s, q]:
                dx, dy, z = x[q] - points[s, 0], y[q] - points[s, 1], points[s, 2]
                facing = normals[s, 0] * dx + normals[s, 1] * dy - normals[s, 2] * z
                given[s, q], _ = _given(dx, dy, z, facing, relay_weight[q], soft_wall, near_m, lambertian)
    return taken, given


def histograms(job: Job) -> Array:
    """Histograms (n, bins) of I_multi over path length, for the job's beams."""
    more = _more_bounces(job) if job.more_bounces else 0.0  # first: it refuses what would take too long
    return _three_bounces(job) + more


def _three_bounces(job: Job) -> Array:
    """In groups of beams, between which Ctrl-C is heard: one beam at a time where a BRDF couples the legs."""
    patches, relay, count = job.patches, job.relay, len(job.foot_m)
    seen = _visible(job, relay.x_m, relay.y_m)
    histogram, group = np.zeros((count, job.bins)), BEAM_GROUP if job.brdf is None else 1
    for which in (slice(start, start + group) for start in range(0, count, group)):
        factor = np.empty((0, 0))
        if job.brdf is not None:
            foot = job.foot_m[which.start]
            factor = scattering(job.brdf)(foot, patches.point_m, patches.normal, relay.x_m, relay.y_m)
        histogram[which] = _some(job, which, seen, factor)
    return histogram


def _more_bounces(job: Job) -> Array:
    p, relay = job.patches, job.relay
    surface = p.point_m, p.normal, job.strength, job.soft_patch_m2
    lit = _visible(job, job.foot_m[:, 0].copy(), job.foot_m[:, 1].copy())
    wall = relay.x_m, relay.y_m, job.relay_weight, job.soft_wall_m2, _visible(job, relay.x_m, relay.y_m)
    taken, given = _ends(job.foot_m, job.beam_weight, lit, *surface, *wall, job.near_m, job.lambertian)
    return more_paths(job, taken, given)


def _visible(job: Job, x_m: Array, y_m: Array) -> Mask:
    """V (n, m) of the legs between the job's patches and points of the wall."""
    p = job.patches
    return legs(p.point_m, p.normal, p.row, p.column, x_m, y_m, *job.edge_m, job.field)


def _some(job: Job, which: slice, seen: Mask, factor: Array) -> Array:
    patches, relay, foot = job.patches, job.relay, np.ascontiguousarray(job.foot_m[which])
    return _paths(
        foot,
        job.length_m[which],
        job.beam_weight[which],
        _visible(job, foot[:, 0].copy(), foot[:, 1].copy()),
        patches.point_m,
        patches.normal,
        job.strength,
        job.soft_patch_m2,
        relay.x_m,
        relay.y_m,
        relay.length_m,
        job.relay_weight,
        job.soft_wall_m2,
        seen,
        factor,
        job.near_m,
        job.lambertian,
        job.bin_m,
        job.bins,
    )
