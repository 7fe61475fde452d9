"""Benchmark of 54 fixed objects: three of each category, with settings that no training seed can draw.

Nothing here is random. Each setting that has a held-out interval takes its value from it (`generators.Setting`); other
settings and the poses are spread evenly over the training ranges.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import Pose, place, pose_from_units

OBJECTS_PER_CATEGORY = 3
POSE_STEPS = (19, 7, 43, 13, 31, 25, 37)
"""Coprime with 54, so that each quantity of a pose takes 54 evenly spaced values; among such sets, one with the lowest
correlation between any two quantities (0.18)."""


@dataclass(frozen=True)
class BenchmarkObject:
    """Benchmark object, placed in an object box."""

    name: str
    """Category and number: cup-2."""
    category: str
    number: int
    """1 to 3."""
    settings: Mapping[str, float]
    """Arguments of the category's generator."""
    pose: Pose
    triangles: Float64 = field(repr=False, compare=False)
    """(n, 3, 3) in the wall frame, in metres."""
    depth_m: Float32 = field(repr=False, compare=False)
    """(64, 64), NaN for background."""


def benchmark_objects(box: ObjectBox) -> list[BenchmarkObject]:
    """Return the 54 objects in the order of the categories, bit for bit the same in every run."""
    return [_object(name, number, box) for name in CATEGORIES for number in range(OBJECTS_PER_CATEGORY)]


def _object(name: str, k: int, box: ObjectBox) -> BenchmarkObject:
    kind, row = CATEGORIES[name], OBJECTS_PER_CATEGORY * list(CATEGORIES).index(name) + k
    settings = kind.draw_held_out(_even(k, 1 + n % 2, OBJECTS_PER_CATEGORY) for n in range(len(kind.settings)))
    pose = pose_from_units([_even(row, step, OBJECTS_PER_CATEGORY * len(CATEGORIES)) for step in POSE_STEPS], box)
    triangles = place(kind.make(**settings), pose, box)
    depth_m = orthographic_depth(triangles, box)
    return BenchmarkObject(f"{name}-{k + 1}", name, k + 1, settings, pose, triangles, depth_m)


def _even(number: int, step: int, count: int) -> float:
    """Return the middle of one of `count` parts of [0, 1]: a permutation of them if step and count are coprime."""
    return (number * step % count + 0.5) / count
