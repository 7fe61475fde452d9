"""Inter-reflection path by path, in float64: what `between` is held against. For small scenes; others are refused."""

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.render.between import object_factors, wall_cells, wall_factors
from nlos_cam.render.job import Job

Array = NDArray[np.float64]

MOST_PATHS = 3e10
"""Some minutes' worth."""


def more_paths(job: Job, taken: Array, given: Array) -> Array:
    """Histograms (n, bins) of the paths that meet the object twice.

    `taken` (n, patches) is the light that each patch gives on of each beam, `given` (patches, m) what the lidar gets of
    it by each relay cell. Raises SceneError where there are more than MOST_PATHS.
    """
    point, cells = job.patches.point_m, wall_cells(job)
    count = taken.size * given.size * len(cells)
    if count > MOST_PATHS:
        raise SceneError(
            f"inter-reflection path by path would sum {count:.1g} paths, at most {MOST_PATHS:.0e}: choose fine, "
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
    taken: Array,
    d2: Array,
    given: Array,
    d3: Array,
    factors: Array,
    points: Array,
    there: Array,
    back: Array,
    to_wall: Array,
    bin_m: float,
    bins: int,
) -> Array:
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
