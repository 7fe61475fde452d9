"""Tables of a BRDF for beams: the factor that couples the leg to a patch with the leg from it.

A BRDF depends on both directions, so S2 no longer factorizes at the patch. But for one laser spot
the incoming direction at each patch is fixed, and the patches' tables can hold the factor. Tables
are made for a grid of spots (nodes), and each beam takes those around it with bilinear weights.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.render.job import TransportJob
from nlos_cam.render.material import Brdf

PROBES = 4096
"""Legs on which the interpolation is checked."""
MAX_NODES = 64
"""Limit along each axis."""
Scattering = Callable[[Float64, Float64, Float64, Float64, Float64], Float64]


@lru_cache(maxsize=8)
def scattering(brdf: Brdf) -> Scattering:
    """Return the compiled factor of a BRDF: (spot (3,), points (n, 3), normals (n, 3), x (m,), y
    (m,)) -> (n, m).

    Compiled once per process and BRDF, which takes some seconds.
    """
    compiled: Any = numba.njit(brdf)

    @numba.njit(parallel=True)
    def factor(foot: Float64, points: Float64, normals: Float64, x: Float64, y: Float64) -> Float64:
        table = np.empty((len(points), len(x)))
        for s in numba.prange(len(points)):
            point = points[s]
            normal = normals[s]
            to_foot = foot - point
            to_foot = to_foot / max(np.sqrt((to_foot**2).sum()), 1e-12)
            cos_in = (to_foot * normal).sum()
            for q in range(len(x)):
                dx = x[q] - point[0]
                dy = y[q] - point[1]
                d3 = max(
                    np.sqrt(dx**2 + dy**2 + point[2] ** 2), 1e-12
                )  # where the object touches the wall
                cos_out = (normal[0] * dx + normal[1] * dy - normal[2] * point[2]) / d3
                cos_between = (to_foot[0] * dx + to_foot[1] * dy - to_foot[2] * point[2]) / d3
                table[s, q] = compiled(max(cos_in, 0.0), max(cos_out, 0.0), cos_between)
        return table

    return factor


def scattered(brdf: Brdf, foot: Float64, point: Float64, normal: Float64, out: Float64) -> Float64:
    """Return the same factor (n,) leg by leg: spots, points, normals and wall points (n, 3),
    without compiling.
    """
    to_foot = foot - point
    to_wall = out - point
    to_foot /= np.maximum(np.linalg.norm(to_foot, axis=1, keepdims=True), 1e-12)
    to_wall /= np.maximum(np.linalg.norm(to_wall, axis=1, keepdims=True), 1e-12)
    cos_in = (to_foot * normal).sum(1)
    cos_out = (to_wall * normal).sum(1)
    return brdf(
        np.maximum(cos_in, 0.0), np.maximum(cos_out, 0.0), (to_foot * to_wall).sum(1)
    ) + np.zeros(len(foot))


def nodes(job: TransportJob, brdf: Brdf) -> Iterator[tuple[Float64, Float64]]:
    """Yield spots (3,) of a grid with their bilinear weights (n,) for each beam.

    Columns and rows of the grid are quantiles of the map's own spots, so that nodes are dense where
    beams are.
    """
    lines = _lines(job.map_spots_m, node_count(job, brdf))
    hats = [_hats(job.laser_spot_m[:, axis], line) for axis, line in enumerate(lines)]
    for i, x in enumerate(lines[0]):
        for j, y in enumerate(lines[1]):
            share = hats[0][i] * hats[1][j]
            if share.any():
                yield np.array([x, y, 0.0]), share


def _lines(laser_spot_m: Float64, count: int) -> list[Float64]:
    return [
        np.unique(np.quantile(laser_spot_m[:, axis], np.linspace(0, 1, count))).astype(np.float64)
        for axis in (0, 1)
    ]


def node_count(job: TransportJob, brdf: Brdf) -> int:
    """Return the nodes along each axis that keep the interpolation within the accuracy's error, on
    sample legs.
    """
    generator = np.random.default_rng(0)
    patches = job.patches
    relay = job.relay
    s = generator.integers(len(patches.beta), size=PROBES)
    q = generator.integers(len(relay.x_m), size=PROBES)
    out = np.stack([relay.x_m[q], relay.y_m[q], np.zeros(PROBES)], 1)
    foot = job.map_spots_m[generator.integers(len(job.map_spots_m), size=PROBES)]
    exact = scattered(brdf, foot, patches.point_m[s], patches.normal[s], out)
    count = 4
    # Legs to the dark side of a patch carry no light: the backends set their weight to 0, so their
    # error does not count.
    lit = np.all(
        [((end - patches.point_m[s]) * patches.normal[s]).sum(1) > 0 for end in (foot, out)], axis=0
    )
    # Bilinear interpolation is of second order: doubling the nodes divides the error of a smooth
    # BRDF by about four.
    while count < MAX_NODES:
        corners = [
            _bracket(foot[:, axis], line)
            for axis, line in enumerate(_lines(job.map_spots_m, count))
        ]
        guess = np.zeros(PROBES)
        for i in (0, 1):
            for j in (0, 1):
                at = np.stack([corners[0][i], corners[1][j], np.zeros(PROBES)], 1)
                share = np.abs(1 - i - corners[0][2]) * np.abs(1 - j - corners[1][2])
                guess += share * scattered(brdf, at, patches.point_m[s], patches.normal[s], out)
        if np.abs(guess - exact)[lit].sum() <= job.accuracy.scatter_error * exact[lit].sum():
            break
        count *= 2
    return count


def _bracket(at: Float64, line: Float64) -> tuple[Float64, Float64, Float64]:
    """Return the points of a line before and after, and the position in between (0 to 1)."""
    before = np.clip(np.searchsorted(line, at, "right") - 1, 0, max(len(line) - 2, 0))
    low = line[before]
    high = line[np.minimum(before + 1, len(line) - 1)]
    return low, high, np.divide(at - low, high - low, out=np.zeros_like(at), where=high > low)


def _hats(at: Float64, line: Float64) -> Float64:
    """Return linear interpolation between the points of a line as weights (len(line), len(at))."""
    return np.stack([np.interp(at, line, one) for one in np.eye(len(line))])
