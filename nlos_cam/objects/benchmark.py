"""The 54 fixed objects that judge: three of each category, with settings that no training seed can draw.

Nothing here is random. Every setting of a generator that has an interval held out from training takes its value from
there (`nlos_cam.objects.settings`); other settings and the poses are spread evenly over training's ranges.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import Pose, place, pose_from

OF_EACH = 3
POSE_STEPS = (19, 7, 43, 13, 31, 25, 37)
"""Coprime with 54, so that each quantity of a pose takes 54 evenly spaced values; of all such sets, one with the least
correlation between any two (0.18)."""


@dataclass(frozen=True)
class FixedObject:
    """One object of the test set, as it stands in a box."""

    name: str
    """The category and the number: cup-2."""
    category: str
    number: int
    """1 to 3."""
    settings: Mapping[str, float]
    """Of the category's generator."""
    pose: Pose
    triangles: Float64 = field(repr=False, compare=False)
    """(n, 3, 3) in the wall frame, in metres."""
    depth_m: Float32 = field(repr=False, compare=False)
    """(64, 64), NaN for background."""


def benchmark_objects(box: ObjectBox) -> list[FixedObject]:
    """The 54 objects in the order of the categories: the same bits in every run."""
    return list(_objects(box))


benchmark_objects.__test__ = False  # pyright: ignore[reportFunctionMemberAccess]  (its name is no test's, whatever pytest thinks)


def _objects(box: ObjectBox) -> Iterator[FixedObject]:
    for which, (name, kind) in enumerate(CATEGORIES.items()):
        for k in range(OF_EACH):
            settings = kind.kept(_even(k, 1 + n % 2, OF_EACH) for n in range(len(kind.settings)))
            pose = pose_from([_even(OF_EACH * which + k, step, OF_EACH * len(CATEGORIES)) for step in POSE_STEPS], box)
            triangles = place(kind.make(**settings), pose, box)
            depth_m = orthographic_depth(triangles, box)
            yield FixedObject(f"{name}-{k + 1}", name, k + 1, settings, pose, triangles, depth_m)


def _even(number: int, step: int, count: int) -> float:
    """The middle of one of `count` equal parts of [0, 1]: another for each number if step and count are coprime."""
    return (number * step % count + 0.5) / count
