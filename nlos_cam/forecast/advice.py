"""What to change on a bench: nearer, turned, another gap, another place; each by its own forecast."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from nlos_calibration import (
    DISTANCE_RANGE_M,
    FACING_RANGE_DEG,
    GAP_RANGE_M,
    Rig,
    lidar_visible_share,
)

from nlos_cam.forecast.curve import network_iou
from nlos_cam.forecast.expectation import Conditions, expectation, posteriors, typical_shapes
from nlos_cam.forecast.linear import Echoes, echoes_of
from nlos_cam.objects import object_box
from nlos_cam.render import SensorModel

OBJECTS = 4
NEARER_M = 0.03
TURN_DEG = 10.0
GAP_M = 0.03
ALONG_M = 0.10
MORE_DIRECT_SIGHT = 0.005
"""Share of the box that a change may bring into the lidar's sight: the task would be another."""


@dataclass(frozen=True)
class Change:
    """One change of a rig, and what it is worth with one frame of a matt object."""

    words: str
    rig: Rig
    gain_iou: float
    """Change of the silhouette IoU that a trained network is expected to have."""
    as_second_gain_iou: float | None
    """The same if the lidar sees from both places in turn; None for a change of the occluder."""


def changes(
    rig: Rig, on_progress: Callable[[int, int], None] = lambda _done, _of: None
) -> list[Change]:
    """Return all changes that the paper's ranges allow, the most gain first.

    Raises SceneError for a rig without an object box.
    """
    box = object_box(rig)
    span_m = box.z_far_m - box.z_near_m
    shapes = typical_shapes(rig)[:OBJECTS]
    sensor = SensorModel()
    now = [echoes_of(rig, shape, sensor)["matt"] for shape in shapes]

    def iou(echoes: list[Echoes]) -> float:
        found = posteriors(shapes, echoes, 1)
        return network_iou(expectation(Conditions(), found, echoes, span_m).linear_iou)

    before = iou(now)
    candidates = list(_candidates(rig))
    found: list[Change] = []
    for i, (words, other, moves_lidar) in enumerate(candidates):
        there = [echoes_of(other, shape, sensor)["matt"] for shape in shapes]
        both = [mine.and_those(more) for mine, more in zip(now, there, strict=True)]
        second = iou(both) - before if moves_lidar else None
        found.append(Change(words, other, iou(there) - before, second))
        on_progress(i + 1, len(candidates))
    return sorted(found, key=lambda change: -change.gain_iou)


def _candidates(rig: Rig) -> Iterator[tuple[str, Rig, bool]]:
    """Yield changes within the paper's ranges in words, as a rig, and whether the lidar moves."""
    direct = lidar_visible_share(rig, object_box(rig)) + MORE_DIRECT_SIGHT
    lidar = rig.lidar
    low_m, high_m = DISTANCE_RANGE_M
    low_deg, high_deg = FACING_RANGE_DEG
    tries: list[tuple[str, Rig, bool]] = []
    for step_m, word in ((-NEARER_M, "nearer to the wall"), (NEARER_M, "farther from the wall")):
        distance_m = _stepped(lidar.distance_m, step_m, low_m, high_m)
        moved = lidar.model_copy(update={"distance_m": distance_m})
        text = f"lidar {word}: {distance_m:.2f} m in place of {lidar.distance_m:.2f} m"
        tries.append((text, rig.model_copy(update={"lidar": moved}), True))
    for step_deg, word in ((-TURN_DEG, "less"), (TURN_DEG, "more")):
        # The wall's normal is at 0: a turn away from it goes on in the direction of the yaw.
        side = -1.0 if lidar.yaw_deg < 0 else 1.0
        yaw_deg = side * _stepped(abs(lidar.yaw_deg), step_deg, low_deg, high_deg)
        turned = lidar.model_copy(update={"yaw_deg": yaw_deg})
        text = f"lidar turned {word}: {yaw_deg:.0f} degrees in place of {lidar.yaw_deg:.0f}"
        tries.append((text, rig.model_copy(update={"lidar": turned}), True))
    for step_m, word in ((-ALONG_M, "away from the object"), (ALONG_M, "towards the object")):
        text = f"lidar {ALONG_M * 100:.0f} cm along the wall, {word}"
        place_m = np.array([step_m, 0.0, lidar.distance_m])
        tries.append((text, rig.seen_from(place_m), True))
    if rig.occluder is not None:
        for step_m, word in ((-GAP_M, "narrower"), (GAP_M, "wider")):
            gap_m = _stepped(rig.occluder.z_min_m, step_m, *GAP_RANGE_M)
            occluder = rig.occluder.model_copy(update={"z_min_m": gap_m})
            text = f"gap {word}: {gap_m:.2f} m in place of {rig.occluder.z_min_m:.2f} m"
            tries.append((text, rig.model_copy(update={"occluder": occluder}), False))
    for text, other, moves_lidar in tries:
        if other != rig and lidar_visible_share(other, object_box(other)) <= direct:
            yield text, other, moves_lidar


def _stepped(value: float, step: float, low: float, high: float) -> float:
    """Return a value after a step that ends at a range's limits; the value itself where the range
    lies the other way.
    """
    there = float(np.clip(value + step, low, high))
    return there if (there - value) * step > 0 else value
