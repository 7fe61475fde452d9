"""Near contact: 1 / d^2 from the middle of a cell is its average only from afar."""

from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NEAR_DIAGONALS = 4
"""Near contact begins at this many diagonals of the larger cell."""
MANY = 1.2
"""Neighbours take their share too: without this a plane of square cells takes 7 % more than was sent. It suffices for
cells up to twice as long as wide."""
Area = TypeVar("Area", Array, float)


def solid_angle(*, lambertian: bool) -> float:
    """What each bounce spreads its light over: pi with the cosine of the rendering equation, 2 pi without (S1, S2)."""
    return np.pi if lambertian else 2 * np.pi


def contact_m2(area_m2: Area, solid_angle: float) -> Area:
    """What near contact adds to d^2 at one cell of many: with it, a plane of cells takes no more than was sent."""
    return MANY * area_m2 / solid_angle


@numba.vectorize([numba.float64(numba.float64, numba.float64, numba.float64)], cache=True)
def softened(squared_m2: Any, soft_m2: Any, near_m: Any) -> Any:
    """d^2 that stays finite at contact: plus the receiving area over the solid angle, fading out towards `near_m`.

    On the axis of a disc of area a the average of 1 / d^2 is 1 / (d^2 + a / pi), by which it never takes more than
    was sent. Beyond a few diagonals the two agree, and S1 and S2 hold to the letter. For arrays, and in compiled loops.
    """
    if squared_m2 >= near_m * near_m:
        return squared_m2
    ramp = 1 - squared_m2 / (near_m * near_m)
    return squared_m2 + soft_m2 * ramp * ramp
