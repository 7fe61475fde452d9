"""The renderer that defines the others: every three-bounce path by itself, in float64 (S2 to S4).

Slow on purpose (it is compiled, and still takes a minute or two for a whole map): each line is an equation.

Inter-reflection path by path, in float64: what `between` is held against. For small scenes; others are refused.
"""

import numba
import numpy as np
from nlos_calibration.arrays import Float64, Int64, Mask

from nlos_cam.errors import SceneError
from nlos_cam.render.brdf_table import scattering
from nlos_cam.render.geometry import softened
from nlos_cam.render.interreflection import object_factors, wall_cells, wall_factors
from nlos_cam.render.job import TransportJob
from nlos_cam.render.visibility import HeightField, occluded, visible

MAX_PATHS = 3e10
"""Some minutes' worth."""


def more_paths(job: TransportJob, taken: Float64, given: Float64) -> Float64:
    """Histograms (n, bins) of the paths that meet the object twice.

    `taken` (n, patches) is the light that each patch gives on of each beam, `given` (patches, m) what the lidar gets of
    it by each relay cell. Raises SceneError where there are more than MAX_PATHS.
    """
    point, cells = job.patches.point_m, wall_cells(job)
    count = taken.size * given.size * len(cells)
    if count > MAX_PATHS:
        raise SceneError(
            f"inter-reflection path by path would sum {count:.1g} paths, at most {MAX_PATHS:.0e}: choose fine, "
            "or leave inter-reflection out of the effects"
        )
    relay = np.stack([job.relay.x_m, job.relay.y_m, np.zeros_like(job.relay.x_m)], 1)
    there, back = wall_factors(job, cells)
    d2 = np.linalg.norm(job.foot_m[:, None] - point, axis=-1) + job.length_m[:, None]
    d3 = np.linalg.norm(point[:, None] - relay, axis=-1) + job.relay.length_m
    to_wall = np.linalg.norm(point[:, None] - cells, axis=-1)
    factors = object_factors(job)
    return _sum(taken, d2, given, d3, factors, point, there, back, to_wall, job.bin_m, job.bins)


@numba.njit(cache=True, parallel=True)
def _sum(
    taken: Float64,
    d2: Float64,
    given: Float64,
    d3: Float64,
    factors: Float64,
    points: Float64,
    there: Float64,
    back: Float64,
    to_wall: Float64,
    bin_m: float,
    bins: int,
) -> Float64:
    histogram = np.zeros((len(taken), bins))
    for p in numba.prange(len(taken)):
        for a in range(len(points)):
            if taken[p, a] == 0:
                continue
            for b in range(len(points)):
                away = np.sqrt(((points[a] - points[b]) ** 2).sum())
                for q in range(given.shape[1]):
                    ends, light = d2[p, a] + d3[b, q], taken[p, a] * given[b, q]
                    if light == 0:
                        continue
                    k = int(np.floor((ends + away) / bin_m))
                    if k < bins:
                        histogram[p, k] += light * factors[a, b]
                    for w in range(there.shape[1]):
                        k = int(np.floor((ends + to_wall[a, w] + to_wall[b, w]) / bin_m))
                        if k < bins:
                            histogram[p, k] += light * there[a, w] * back[b, w]
    return histogram


BEAM_GROUP = 256
"""Beams summed in one compiled call."""


@numba.njit(cache=True, parallel=True)
def legs(
    points: Float64,
    normals: Float64,
    rows: Int64,
    columns: Int64,
    x: Float64,
    y: Float64,
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
    foot: Float64, normal: Float64, point: Float64, strength: float, soft: float, near_m: float, lambertian: bool
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
    foot: Float64,
    d1: Float64,
    beam_weight: Float64,
    lit: Mask,
    points: Float64,
    normals: Float64,
    strength: Float64,
    soft_patch: Float64,
    x: Float64,
    y: Float64,
    d4: Float64,
    relay_weight: Float64,
    soft_wall: float,
    seen: Mask,
    factor: Float64,
    near_m: float,
    lambertian: bool,
    bin_m: float,
    bins: int,
) -> Float64:
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
    foot: Float64,
    beam_weight: Float64,
    lit: Mask,
    points: Float64,
    normals: Float64,
    strength: Float64,
    soft_patch: Float64,
    x: Float64,
    y: Float64,
    relay_weight: Float64,
    soft_wall: float,
    seen: Mask,
    near_m: float,
    lambertian: bool,
) -> tuple[Float64, Float64]:
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


def histograms(job: TransportJob) -> Float64:
    """Histograms (n, bins) of I_multi over path length, for the job's beams."""
    more = _more_bounces(job) if job.more_bounces else 0.0  # first: it refuses what would take too long
    return _three_bounces(job) + more


def _three_bounces(job: TransportJob) -> Float64:
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


def _more_bounces(job: TransportJob) -> Float64:
    p, relay = job.patches, job.relay
    surface = p.point_m, p.normal, job.strength, job.soft_patch_m2
    lit = _visible(job, job.foot_m[:, 0].copy(), job.foot_m[:, 1].copy())
    wall = relay.x_m, relay.y_m, job.relay_weight, job.soft_wall_m2, _visible(job, relay.x_m, relay.y_m)
    taken, given = _ends(job.foot_m, job.beam_weight, lit, *surface, *wall, job.near_m, job.lambertian)
    return more_paths(job, taken, given)


def _visible(job: TransportJob, x_m: Float64, y_m: Float64) -> Mask:
    """V (n, m) of the legs between the job's patches and points of the wall."""
    p = job.patches
    return legs(p.point_m, p.normal, p.row, p.column, x_m, y_m, *job.edge_m, job.field)


def _some(job: TransportJob, which: slice, seen: Mask, factor: Float64) -> Float64:
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
