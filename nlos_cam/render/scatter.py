"""A BRDF on the legs of one beam's foot: the factor that couples the way to a patch with the way from it."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.render.surface import Brdf

Array = NDArray[np.float64]
Scattering = Callable[[Array, Array, Array, Array, Array], Array]


@lru_cache(maxsize=8)
def scattering(brdf: Brdf) -> Scattering:
    """The compiled factor of a BRDF: (foot (3,), points (n, 3), normals (n, 3), x (m,), y (m,)) -> (n, m).

    Compiled once a process and a BRDF, which takes some seconds.
    """
    compiled: Any = numba.njit(brdf)

    @numba.njit(parallel=True)
    def factor(foot: Array, points: Array, normals: Array, x: Array, y: Array) -> Array:
        table = np.empty((len(points), len(x)))
        for s in numba.prange(len(points)):
            point, normal = points[s], normals[s]
            to_foot = foot - point
            to_foot = to_foot / np.sqrt((to_foot**2).sum())
            cos_in = (to_foot * normal).sum()
            for q in range(len(x)):
                dx, dy = x[q] - point[0], y[q] - point[1]
                d3 = np.sqrt(dx**2 + dy**2 + point[2] ** 2)
                cos_out = (normal[0] * dx + normal[1] * dy - normal[2] * point[2]) / d3
                cos_between = (to_foot[0] * dx + to_foot[1] * dy - to_foot[2] * point[2]) / d3
                table[s, q] = compiled(cos_in, cos_out, cos_between) if cos_in > 0 and cos_out > 0 else 0.0
        return table

    return factor
