"""Rigs that an owner may build, drawn at random: those that the paper allows (SI 1)."""

from collections.abc import Sequence
from itertools import product
from typing import Annotated, Self

import numpy as np
from nlos_calibration import (
    DISTANCE_RANGE_M,
    FACING_RANGE_DEG,
    GAP_RANGE_M,
    ObjectBox,
    Occluder,
    Record,
    Rig,
)
from pydantic import Field, model_validator

from nlos_cam.errors import SceneError
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import (
    ALONG_RANGE_M,
    ASIDE_RANGE_M,
    OCCLUDER_RANGE_M,
    PITCH_RANGE_DEG,
)

Metres = Annotated[float, Field(ge=-1, le=1)]
Degrees = Annotated[float, Field(gt=-90, lt=90)]
Range = tuple[Metres, Metres]
"""Lowest and highest value, drawn uniformly."""
OBJECTS_PER_RIG = 25
"""Objects that share a rig: what depends on the rig alone is then computed once."""
MARGIN_M = 0.005
"""Distance that stays between the occluder's edge and the line of sight from the lidar to the box."""
SHARES = 7
"""Random numbers of a rig, one for each range."""
_STREAM = 4
"""Stream of a rig's random numbers; see `plan._RIG_STREAM`."""


class RigRange(Record):
    """Range of the rigs that objects are drawn on, around a rig whose wall and box's size they
    keep.

    These rigs are known: networks get maps that are aligned by them, and their numbers. What is not
    known of a rig is a RigSpread.
    """

    distance_m: Range = DISTANCE_RANGE_M
    yaw_deg: tuple[Degrees, Degrees] = FACING_RANGE_DEG
    pitch_deg: tuple[Degrees, Degrees] = PITCH_RANGE_DEG
    gap_m: Range = GAP_RANGE_M
    """From the occluder's edge to the wall. A gap through which the lidar would see the box is not
    drawn."""
    along_m: Range = ALONG_RANGE_M
    """Move of the lidar's foot along the wall, away from occluder and box: they move the other way
    in the wall frame."""
    aside_m: Range = ASIDE_RANGE_M
    """Move of the box's middle, wall y."""
    occluder_m: Range = OCCLUDER_RANGE_M
    """Move of the occluder, wall x, against the box."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in type(self).model_fields:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} needs the lower end first")
        return self

    def draw(self, rig: Rig, seed: int) -> Rig:
        """Return the rig of a draw. Raises SceneError for a rig without an occluder."""
        return self._rig_at(rig, np.random.default_rng([seed, _STREAM]).random(SHARES).tolist())

    def extremes(self, rig: Rig) -> list[Rig]:
        """Return the rigs at the ends of all ranges: none that is drawn is nearer to the wall or
        more turned. Raises SceneError as `draw` does.
        """
        return [self._rig_at(rig, share) for share in product((0.0, 1.0), repeat=SHARES)]

    def _rig_at(self, rig: Rig, share: Sequence[float]) -> Rig:
        """Return the rig at a share of each range, from 0 at its lower end to 1."""
        if rig.occluder is None:
            raise SceneError(f"{rig.name} has no occluder, whose gap would be drawn")

        distance_m = _between(self.distance_m, share[0])
        along_m = _between(self.along_m, share[4])
        box = _moved(object_box(rig), -along_m, _between(self.aside_m, share[5]))
        x_m = rig.occluder.x_m - along_m + _between(self.occluder_m, share[6])

        # A lidar that sees the object directly is no bench of this kind.
        low_m, high_m = self.gap_m
        high_m = min(high_m, _sight_m(distance_m, x_m, box) - MARGIN_M)
        if not high_m > 0:
            raise SceneError(
                f"the lidar sees the object box of {rig.name} past any occluder: move the box farther"
                " from the lidar along the wall"
            )
        gap_m = _between((min(low_m, high_m), high_m), share[3])

        lidar = rig.lidar.model_copy(
            update={
                "distance_m": distance_m,
                "yaw_deg": _between(self.yaw_deg, share[1]),
                "pitch_deg": _between(self.pitch_deg, share[2]),
            }
        )
        drawn = {
            "lidar": lidar,
            "occluder": Occluder(x_m=x_m, z_min_m=gap_m),
            "object_box": box,
        }
        return rig.model_copy(update=drawn)


def _between(ends: Range, share: float) -> float:
    low, high = ends
    return low + (high - low) * share


def _moved(box: ObjectBox, x_m: float, y_m: float) -> ObjectBox:
    move = {
        "x_min_m": box.x_min_m + x_m,
        "x_max_m": box.x_max_m + x_m,
        "y_min_m": box.y_min_m + y_m,
        "y_max_m": box.y_max_m + y_m,
    }
    return box.model_copy(update=move)


def _sight_m(distance_m: float, edge_m: float, box: ObjectBox) -> float:
    """Return the smallest distance from the wall at which a line from the lidar to the box passes
    the plane x = edge_m.
    """
    # Lines to the box's nearest edges pass lowest: at its two ends along the wall.
    ends_m = np.array([box.x_min_m, box.x_max_m])
    with np.errstate(divide="ignore", invalid="ignore"):  # a box that begins at the lidar's foot
        passed_m = distance_m + (box.z_near_m - distance_m) * edge_m / ends_m
    return float(passed_m.min())
