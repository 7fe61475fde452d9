"""Way up of a lidar, by gravity: the side of its image that is up, and turns since a measurement.

A bench is symmetric about the lidar's height, so that no image of it shows which way up the lidar
is. Gravity is a vector in m/s^2 that points down, in the lidar frame (x right, y down, z forward).
"""

from math import atan2, degrees, hypot
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

G_M_S2 = 9.80665
AT_REST_M_S2 = 1.0
"""Difference from g beyond which a mean acceleration is that of a device that is being moved."""
TURNED_DEG = 5.0
"""Angle between two measured directions of gravity beyond which the lidar was turned: an
accelerometer of 20 mg zero offset, as an L515's, errs by 1 degree in each.
"""
MIN_ACROSS = 0.5
"""Share of gravity across the optical axis below which no side of the image is up: the lidar looks
more than 60 degrees up or down.
"""
WayUp = Literal["upright", "upside down", "on its side", "unknown"]
Component = Annotated[float, Field(ge=-20, le=20)]


def _at_rest(gravity_m_s2: tuple[float, float, float]) -> tuple[float, float, float]:
    if not is_gravity(gravity_m_s2):
        raise ValueError(f"it has the length {hypot(*gravity_m_s2):.2f}, and gravity has 9.81")
    return gravity_m_s2


Gravity = Annotated[tuple[Component, Component, Component], AfterValidator(_at_rest)]


def is_gravity(acceleration_m_s2: tuple[float, float, float]) -> bool:
    """Return True for an acceleration (3,) as long as gravity's; False for NaN."""
    return abs(hypot(*acceleration_m_s2) - G_M_S2) <= AT_REST_M_S2


def roll_deg(gravity_m_s2: Gravity) -> float:
    """Return the lidar's roll about its optical axis, 0 upright, positive clockwise seen from
    behind.
    """
    # Upright, gravity is along +y. A lidar rolled clockwise has its right side (+x) lowered, so
    # that gravity = g (sin roll, cos roll) across the axis.
    x, y, _ = gravity_m_s2
    return degrees(atan2(x, y))


def way_up(gravity_m_s2: Gravity | None) -> WayUp:
    """Return which side of the image is up, by quarters of a turn; unknown without gravity, and
    where the lidar looks steeply up or down.
    """
    if gravity_m_s2 is None:
        return "unknown"
    x, y, _ = gravity_m_s2
    if hypot(x, y) < MIN_ACROSS * hypot(*gravity_m_s2):
        return "unknown"
    roll = abs(roll_deg(gravity_m_s2))
    if roll <= 45:
        return "upright"
    return "upside down" if roll >= 135 else "on its side"


def turned_deg(one_m_s2: Gravity, other_m_s2: Gravity) -> float:
    """Return the angle between two directions of gravity, 0 to 180."""
    one = np.array(one_m_s2)
    other = np.array(other_m_s2)
    # atan2 of sine and cosine keeps its digits near 0 and 180, where arccos loses them
    sine = float(np.linalg.norm(np.cross(one, other)))
    return degrees(atan2(sine, float(one @ other)))


def turn_problem(
    gravity_m_s2: Gravity | None,
    measured_m_s2: Gravity | None = None,
    measured_way_up: WayUp = "unknown",
) -> str:
    """Return in one line what is wrong with the way up of a lidar now, against that of its wall's
    measurement; empty where nothing is, or gravity is not known.

    Where nothing is known of the measurement, upright is expected.
    """
    if gravity_m_s2 is None:
        return ""
    if measured_m_s2 is not None:
        angle = turned_deg(gravity_m_s2, measured_m_s2)
        if angle <= TURNED_DEG:
            return ""
        return (
            f"the camera was turned by {angle:.0f}° since its wall was measured (by gravity): turn"
            " it back, or calibrate the wall again"
        )
    found = way_up(gravity_m_s2)
    expected = "upright" if measured_way_up == "unknown" else measured_way_up
    if found in {"unknown", expected}:
        return ""
    if measured_way_up == "unknown":
        return f"the camera is {found} (by gravity), and pictures turn with it: turn it upright"
    return (
        f"the camera is {found} (by gravity), and was {expected} when its wall was measured: turn"
        " it back, or calibrate the wall again"
    )
