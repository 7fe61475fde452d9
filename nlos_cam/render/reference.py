"""The renderer that defines the others: every three-bounce path by itself, in float64 (S2 to S4).

Slow on purpose (it is compiled, and still takes a minute or two for a whole map): each line is an equation.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.render.beams import Beams
from nlos_cam.render.relay import Relay
from nlos_cam.render.scene import Patches
from nlos_cam.render.visibility import HeightField, visible

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@numba.njit(cache=True)
def occluded(ax: float, az: float, bx: float, bz: float, edge_x: float, edge_z: float) -> bool:
    """Whether the half plane x = edge_x, z >= edge_z cuts the segment from a to b."""
    if (ax - edge_x) * (bx - edge_x) >= 0:
        return False
    return az + (edge_x - ax) / (bx - ax) * (bz - az) >= edge_z


@numba.njit(cache=True)
def leg_visible(
    point: Array, normal: Array, x: float, y: float, edge_x: float, edge_z: float, field: HeightField
) -> bool:
    """V of one leg between a patch (3,) and a point of the wall: lit side, occluder, the object itself."""
    facing = normal[0] * (x - point[0]) + normal[1] * (y - point[1]) - normal[2] * point[2]
    if facing <= 0 or occluded(point[0], point[2], x, 0.0, edge_x, edge_z):
        return False
    return visible(field, point, x, y)


@numba.njit(cache=True, parallel=True)
def _legs(points: Array, normals: Array, x: Array, y: Array, edge_x: float, edge_z: float, field: HeightField) -> Mask:
    table = np.empty((len(points), len(x)), np.bool_)
    for s in numba.prange(len(points)):
        for w in range(len(x)):
            table[s, w] = leg_visible(points[s], normals[s], x[w], y[w], edge_x, edge_z, field)
    return table


@numba.njit(cache=True, parallel=True)
def _paths(
    foot: Array,
    d1: Array,
    cos_1: Array,
    lit: Mask,
    points: Array,
    normals: Array,
    beta: Array,
    x: Array,
    y: Array,
    d4: Array,
    seen: Mask,
    scale: float,
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
            for q in range(len(x)):
                if not seen[s, q]:
                    continue
                d3 = np.sqrt((x[q] - points[s, 0]) ** 2 + (y[q] - points[s, 1]) ** 2 + points[s, 2] ** 2)
                cos_3 = points[s, 2] / d3
                intensity = scale * cos_1[p] * cos_2 * cos_3 * beta[s] / (d2**2 * d3**2 * d4[q] ** 2)  # S2
                k = int(np.floor((d1[p] + d2 + d3 + d4[q]) / bin_m))  # S4
                if k < bins:
                    histogram[p, k] += intensity
    return histogram


def transient(
    beams: Beams,
    chosen: NDArray[np.int64],
    patches: Patches,
    relay: Relay,
    edge: tuple[float, float],
    field: HeightField,
    bin_m: float,
    bins: int,
) -> Array:
    """Histograms (len(chosen), bins) of I_multi over path length, for some beams that light the wall."""
    foot = np.ascontiguousarray(beams.foot_m[chosen])
    lit = _legs(patches.point_m, patches.normal, foot[:, 0], foot[:, 1], *edge, field)
    seen = _legs(patches.point_m, patches.normal, relay.x_m, relay.y_m, *edge, field)
    scale = relay.cell_m2 * patches.cell_m2 / (2 * np.pi) ** 3  # I0 = 1
    return _paths(
        foot,
        beams.length_m[chosen],
        beams.cos_incidence[chosen],
        lit,
        patches.point_m,
        patches.normal,
        patches.beta,
        relay.x_m,
        relay.y_m,
        relay.length_m,
        seen,
        scale,
        bin_m,
        bins,
    )
