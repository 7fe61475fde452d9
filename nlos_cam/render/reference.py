"""The renderer that defines the others: every three-bounce path by itself, in float64 (S2 to S4).

Slow on purpose (it is compiled, and still takes a minute or two for a whole map): each line is an equation.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.render.job import Job
from nlos_cam.render.near import softened
from nlos_cam.render.scatter import scattering
from nlos_cam.render.visibility import HeightField, visible

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@numba.njit(cache=True)
def occluded(ax: float, az: float, bx: float, bz: float, edge_x: float, edge_z: float) -> bool:
    """Whether the half plane x = edge_x, z >= edge_z cuts the segment from a to b."""
    if (ax - edge_x) * (bx - edge_x) >= 0:
        return False
    return az + (edge_x - ax) / (bx - ax) * (bz - az) >= edge_z


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


_softened = numba.njit(cache=True)(softened)


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
            to_p = foot[p] - points[s]
            d2 = np.sqrt((to_p**2).sum())
            cos_2 = (normals[s] * to_p).sum() / d2
            a = beam_weight[p] * strength[s] * cos_2 / _softened(d2**2, soft_patch[s], near_m)
            if lambertian:
                a *= points[s, 2] / d2  # leaving the wall
            for q in range(len(x)):
                if not seen[s, q]:
                    continue
                d3 = np.sqrt((x[q] - points[s, 0]) ** 2 + (y[q] - points[s, 1]) ** 2 + points[s, 2] ** 2)
                cos_3 = points[s, 2] / d3
                b = relay_weight[q] * cos_3 / _softened(d3**2, soft_wall, near_m)
                if lambertian:  # leaving the object
                    b *= (
                        normals[s, 0] * (x[q] - points[s, 0])
                        + normals[s, 1] * (y[q] - points[s, 1])
                        - normals[s, 2] * points[s, 2]
                    ) / d3
                if factor.size:
                    b *= factor[s, q]
                k = int(np.floor((d1[p] + d2 + d3 + d4[q]) / bin_m))  # S4
                if k < bins:
                    histogram[p, k] += a * b  # S2
    return histogram


def histograms(job: Job) -> Array:
    """Histograms (n, bins) of I_multi over path length, for the job's beams."""
    if job.brdf is None:
        return _some(job, slice(None), np.empty((0, 0)))
    patches, relay, rows = job.patches, job.relay, []
    for p in range(len(job.foot_m)):
        factor = scattering(job.brdf)(job.foot_m[p], patches.point_m, patches.normal, relay.x_m, relay.y_m)
        rows.append(_some(job, slice(p, p + 1), factor))
    return np.concatenate(rows)


def _some(job: Job, which: slice, factor: Array) -> Array:
    patches, relay, foot = job.patches, job.relay, np.ascontiguousarray(job.foot_m[which])
    where = patches.point_m, patches.normal, patches.row, patches.column
    return _paths(
        foot,
        job.length_m[which],
        job.beam_weight[which],
        legs(*where, foot[:, 0].copy(), foot[:, 1].copy(), *job.edge_m, job.field),
        patches.point_m,
        patches.normal,
        job.strength,
        job.soft_patch_m2,
        relay.x_m,
        relay.y_m,
        relay.length_m,
        job.relay_weight,
        job.soft_wall_m2,
        legs(*where, relay.x_m, relay.y_m, *job.edge_m, job.field),
        factor,
        job.near_m,
        job.lambertian,
        job.bin_m,
        job.bins,
    )
