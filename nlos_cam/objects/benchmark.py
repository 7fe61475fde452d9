"""Two benchmarks of 54 fixed objects: of the 18 categories, with settings that no training seed can
draw, and of 18 kinds that training never sees.

Nothing here is random. Each setting that has a held-out interval takes its value from it
(`generators.Setting`); other settings and the poses are spread evenly over the training ranges, and
are the same in both benchmarks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import Pose, place, pose_from_units
from nlos_cam.objects.unseen import KINDS

OBJECTS_PER_CATEGORY = 3
POSE_STEPS = (19, 7, 43, 13, 31, 25, 37)
"""Coprime with 54, so that each quantity of a pose takes 54 evenly spaced values; among such sets,
one with the lowest correlation between any two quantities (0.18)."""


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
    return [
        _object(name, number, box) for name in CATEGORIES for number in range(OBJECTS_PER_CATEGORY)
    ]


def unseen_objects(box: ObjectBox) -> list[BenchmarkObject]:
    """Return 54 objects of kinds that training never sees, three of each, bit for bit the same in
    every run.
    """
    rows = ((name, make, k) for name, make in KINDS.items() for k in range(OBJECTS_PER_CATEGORY))
    return [
        _placed(
            name,
            k,
            {},
            make(k),
            row,
            box,
        )
        for row, (name, make, k) in enumerate(rows)
    ]


def _object(name: str, k: int, box: ObjectBox) -> BenchmarkObject:
    kind = CATEGORIES[name]
    row = OBJECTS_PER_CATEGORY * list(CATEGORIES).index(name) + k
    settings = kind.draw_held_out(
        _even(k, 1 + n % 2, OBJECTS_PER_CATEGORY) for n in range(len(kind.settings))
    )
    return _placed(name, k, settings, kind.make(**settings), row, box)


def _placed(
    name: str, k: int, settings: Mapping[str, float], shape: Float64, row: int, box: ObjectBox
) -> BenchmarkObject:
    pose = pose_from_units(
        [_even(row, step, OBJECTS_PER_CATEGORY * len(CATEGORIES)) for step in POSE_STEPS], box
    )
    triangles = place(shape, pose, box)
    depth_m = orthographic_depth(triangles, box)
    return BenchmarkObject(f"{name}-{k + 1}", name, k + 1, settings, pose, triangles, depth_m)


def _even(number: int, step: int, count: int) -> float:
    """Return the middle of one of `count` parts of [0, 1]: a permutation of them if step and count
    are coprime.
    """
    return (number * step % count + 0.5) / count
