"""A hidden object placed in the object box, and its depth map as the wall sees it.

What a hidden object may stand on or before: a post below it, or a panel behind it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64
from trimesh.transformations import euler_matrix

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import orthographic_depth, share_outside
from nlos_cam.objects.generators import CATEGORIES


def post(depth_m: Float32, generator: np.random.Generator) -> Float32:
    """A flat post (rows, columns) from the object's underside to the bottom of the box, NaN elsewhere."""
    surface = ~np.isnan(depth_m)
    columns = np.flatnonzero(surface.any(axis=0))
    width = max(2, round(generator.uniform(0.1, 0.35) * len(columns)))
    first = columns[0] + (len(columns) - width) // 2
    below = ~np.logical_or.accumulate(surface[::-1])[::-1] & surface.any(axis=0)
    beside = np.abs(np.arange(depth_m.shape[1]) - first - (width - 1) / 2) > width / 2
    return np.where(below & ~beside, np.nanmedian(depth_m), np.nan).astype(np.float32)


def panel(depth_m: Float32, box: ObjectBox, generator: np.random.Generator) -> Float32:
    """A panel (rows, columns) parallel to the wall, of 60 to 100 % of the box's width and height, NaN elsewhere."""
    z_m = generator.uniform(np.nanmax(depth_m), box.z_far_m)
    inside = [
        np.abs((np.arange(cells) + 0.5) / cells - 0.5) <= generator.uniform(0.6, 1.0) / 2 for cells in depth_m.shape
    ]
    return np.where(inside[0][:, None] & inside[1], z_m, np.nan).astype(np.float32)


def with_background(depth_m: Float32, box: ObjectBox, generator: np.random.Generator) -> Float32:
    """An object's depth map (rows, columns) with a random post or panel where it has no surface."""
    behind = post(depth_m, generator) if generator.random() < 0.5 else panel(depth_m, box, generator)
    return np.where(np.isnan(depth_m), behind, depth_m)


POSE_UNITS = 7
"""Numbers that decide a pose."""


@dataclass(frozen=True)
class Pose:
    """Where an object stands in the box: angles about wall x, y, z in turn; offsets from the box's middle."""

    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    turn_z_rad: float = 0.0
    size_m: float = 0.2
    """The larger of its extents along x and y, once turned."""
    x_m: float = 0.0
    y_m: float = 0.0
    front_m: float = 0.03
    """From z_near to the object's nearest point."""


def category_triangles(category: str, seed: int) -> Float64:
    """The triangles (n, 3, 3) of one variation of a category, in its own units. Raises SceneError if unknown."""
    kind = CATEGORIES[_known([category])[0]]
    return kind.make(**kind.drawn(np.random.default_rng(seed).random(len(kind.settings))))


@dataclass(frozen=True)
class Fit:
    """How much of a placed object the box takes."""

    depth_m: float
    """Along z, before it is flattened."""
    room_m: float
    """Depth of the box behind the object's front: a deeper thing is flattened to it."""
    outside: float
    """Share of its silhouette that lies beside the box, and is cut off."""


def fit(triangles: Float64, pose: Pose, box: ObjectBox) -> Fit:
    """How `place` and the rasteriser make an object fit the box."""
    depth_m = float(np.ptp(_at_size(triangles, pose)[:, 2]))
    return Fit(depth_m, _room_m(pose, box), share_outside(place(triangles, pose, box), box))


def place(triangles: Float64, pose: Pose, box: ObjectBox) -> Float64:
    """The triangles (n, 3, 3) turned, scaled and moved into the box, in the wall frame.

    A thing deeper than the box is flattened to fit: its silhouette stays. Raises SceneError where front_m leaves none.
    """
    points = _at_size(triangles, pose)
    points[:, 2] *= min(1.0, _room_m(pose, box) / max(np.ptp(points[:, 2]), 1e-9))
    middle_x, middle_y = (box.x_min_m + box.x_max_m) / 2, (box.y_min_m + box.y_max_m) / 2
    points += (middle_x + pose.x_m, middle_y + pose.y_m, box.z_near_m + pose.front_m - points[:, 2].min())
    return points.reshape(-1, 3, 3)


def nothing_to_see(label: str, box: ObjectBox) -> SceneError:
    """The error of an object that shows the wall nothing."""
    return SceneError(
        f"{label} shows no surface in the object box (x {box.x_min_m:g} to {box.x_max_m:g} m, y {box.y_min_m:g} to "
        f"{box.y_max_m:g} m): it lies beside it, is seen edge on or misses every cell; change x_m, y_m, size_m or its "
        "angles"
    )


def _at_size(triangles: Float64, pose: Pose) -> Float64:
    """The corners (3 n, 3), turned and scaled about their middle."""
    turn = euler_matrix(pose.tilt_x_rad, pose.tilt_y_rad, pose.turn_z_rad)[:3, :3]
    points = triangles.reshape(-1, 3) @ turn.T
    points = points - (points.min(0) + points.max(0)) / 2
    points *= pose.size_m / np.ptp(points[:, :2], axis=0).max()
    return points


def _room_m(pose: Pose, box: ObjectBox) -> float:
    room_m = box.z_far_m - box.z_near_m - pose.front_m
    if room_m < 0:
        raise SceneError(
            f"front_m of {pose.front_m:g} m leaves the box, which is {room_m + pose.front_m:g} m deep: lower it"
        )
    return room_m


def pose_from(units: Sequence[float], box: ObjectBox) -> Pose:
    """The pose that seven numbers in [0, 1] mean; it keeps the whole object in the box.

    In turn: size (55 to 90 % of the box), tilts (to 15 and 20 degrees), turn (to 35), place, and distance (the object's
    front is in the nearest 35 % of the box). Random poses are even over all of these.
    """
    size, tilt_x, tilt_y, turn_z, right, up, front = units
    width_m = min(box.x_max_m - box.x_min_m, box.y_max_m - box.y_min_m)
    size_m = width_m * (0.55 + 0.35 * size)
    spare_m = (width_m - size_m) / 2
    return Pose(
        tilt_x_rad=radians(30 * tilt_x - 15),
        tilt_y_rad=radians(40 * tilt_y - 20),
        turn_z_rad=radians(70 * turn_z - 35),
        size_m=size_m,
        x_m=spare_m * (2 * right - 1),
        y_m=spare_m * (2 * up - 1),
        front_m=0.35 * front * (box.z_far_m - box.z_near_m),
    )


def random_pose(generator: np.random.Generator, box: ObjectBox) -> Pose:
    """A pose that keeps the whole object in the box, even over all that `pose_from` makes."""
    return pose_from(generator.random(POSE_UNITS).tolist(), box)


def object_depth(
    seed: int, box: ObjectBox, categories: Sequence[str] | None = None, *, backgrounds: float = 0.0
) -> tuple[str, Float32]:
    """One random object: its category and its depth map (64, 64) in metres, NaN background; the seed decides all.

    `categories` are those it is one of; without them, any. `backgrounds` is the share of objects that have a post or a
    panel beside them: the objects stay the same. Raises SceneError where there is no category, or an unknown one.
    """
    generator = np.random.default_rng([seed, OBJECT_PIXELS])
    category = str(generator.choice(_known(CATEGORIES if categories is None else categories)))
    triangles = category_triangles(category, int(generator.integers(2**31)))
    depth_m = orthographic_depth(place(triangles, random_pose(generator, box), box), box)
    return category, with_background(depth_m, box, generator) if generator.random() < backgrounds else depth_m


def object_depths(
    seeds: Sequence[int], box: ObjectBox, categories: Sequence[str] | None = None, *, backgrounds: float = 0.0
) -> Iterator[Float32]:
    """Depth maps (64, 64) of many random objects, in the order of their seeds; see `object_depth`."""
    for seed in seeds:
        yield object_depth(seed, box, categories, backgrounds=backgrounds)[1]


def _known(categories: Iterable[str]) -> list[str]:
    names = list(categories)
    if not names:
        raise SceneError(f"no object category is left: choose some of {', '.join(CATEGORIES)}")
    for name in names:
        if name not in CATEGORIES:
            raise SceneError(f"no object category {name!r}: choose one of {', '.join(CATEGORIES)}")
    return names
