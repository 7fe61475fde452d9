"""Placement of objects in the object box: poses, random objects, and the posts and panels beside
some of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, radians

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import orthographic_depth, share_outside
from nlos_cam.objects.generators import CATEGORIES, find_category

POSE_UNITS = 7
"""Numbers in [0, 1] that decide a pose."""


@dataclass(frozen=True)
class Pose:
    """Pose of an object in the box: angles about wall x, y and z in turn, size, and offsets from
    the box's middle. Raises SceneError for a size or a gap that no object has.
    """

    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    turn_z_rad: float = 0.0
    size_m: float = 0.2
    """The larger of its extents along x and y, once turned."""
    x_m: float = 0.0
    y_m: float = 0.0
    front_m: float = 0.03
    """From z_near to the object's nearest point."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isfinite(value):
                raise SceneError(f"{name} is {value}: it must be finite")
        if not self.size_m > 0:
            raise SceneError(f"size_m is {self.size_m:g}: it must be above 0")
        if not self.front_m >= 0:
            raise SceneError(f"front_m is {self.front_m:g}: it must be at least 0")


@dataclass(frozen=True)
class BoxFit:
    """Extent of a placed object compared with the box."""

    depth_m: float
    """Along z, before it is flattened."""
    room_m: float
    """Depth of the box behind the object's front; a deeper object is flattened to it."""
    outside: float
    """Share of its silhouette that lies beside the box, and is cut off."""


def post(depth_m: Float32, generator: np.random.Generator) -> Float32:
    """Return a flat post (rows, columns) from the object's underside to the bottom of the box, NaN
    elsewhere.
    """
    # Below a column's lowest surface: no surface in it from the bottom up to there.
    surface = ~np.isnan(depth_m)
    columns = np.flatnonzero(surface.any(axis=0))
    width = max(2, round(generator.uniform(0.1, 0.35) * len(columns)))
    first = columns[0] + (len(columns) - width) // 2
    below = ~np.logical_or.accumulate(surface[::-1])[::-1] & surface.any(axis=0)
    beside = np.abs(np.arange(depth_m.shape[1]) - first - (width - 1) / 2) > width / 2
    return np.where(below & ~beside, np.nanmedian(depth_m), np.nan).astype(np.float32)


def panel(depth_m: Float32, box: ObjectBox, generator: np.random.Generator) -> Float32:
    """Return a panel (rows, columns) behind the object, parallel to the wall, over 60 to 100 % of
    the box's sides.
    """
    # Behind the whole object, so that the panel never hides a part of it. Rounded to float32, an
    # object that ends at the back of the box ends behind it.
    back_m = min(float(np.nanmax(depth_m)), box.z_far_m)
    z_m = generator.uniform(back_m, box.z_far_m)
    rows, columns = (
        np.abs((np.arange(cells) + 0.5) / cells - 0.5) <= generator.uniform(0.6, 1.0) / 2
        for cells in depth_m.shape
    )
    return np.where(rows[:, None] & columns, z_m, np.nan).astype(np.float32)


def add_background(depth_m: Float32, box: ObjectBox, generator: np.random.Generator) -> Float32:
    """Return an object's depth map (rows, columns) with a random post or panel where it has no
    surface.
    """
    stands = generator.random() < 0.5
    behind = post(depth_m, generator) if stands else panel(depth_m, box, generator)
    return np.where(np.isnan(depth_m), behind, depth_m)


def category_triangles(category: str, seed: int) -> Float64:
    """Return the triangles (n, 3, 3) of one variation of a category, in its own units. Raises
    SceneError if unknown, and for a negative seed.
    """
    if seed < 0:
        raise SceneError(f"seed is {seed}: it must be at least 0")
    kind = find_category(category)
    return kind.make(**kind.draw(np.random.default_rng(seed).random(len(kind.settings))))


def fit_in_box(triangles: Float64, pose: Pose, box: ObjectBox) -> BoxFit:
    """Return the depth of a placed object, the room for it, and the share of it that the box cuts
    off.
    """
    depth_m = float(np.ptp(_turn_and_scale(triangles, pose)[:, 2]))
    return BoxFit(depth_m, _room_m(pose, box), share_outside(place(triangles, pose, box), box))


def place(triangles: Float64, pose: Pose, box: ObjectBox) -> Float64:
    """Return triangles (n, 3, 3) turned, scaled and moved into the box, in the wall frame.

    An object deeper than the box is flattened along z; its silhouette stays. Raises SceneError
    where front_m lies behind the box.
    """
    points = _turn_and_scale(triangles, pose)
    # Flattened along z only: what the wall sees of the outline stays.
    points[:, 2] *= min(
        1.0,
        _room_m(pose, box) / max(np.ptp(points[:, 2]), 1e-9),
    )
    middle_x = (box.x_min_m + box.x_max_m) / 2
    middle_y = (box.y_min_m + box.y_max_m) / 2
    points += (
        middle_x + pose.x_m,
        middle_y + pose.y_m,
        box.z_near_m + pose.front_m - points[:, 2].min(),
    )
    return points.reshape(-1, 3, 3)


def invisible_object_error(label: str, box: ObjectBox) -> SceneError:
    """Return the error of an object that has no surface in its depth map."""
    return SceneError(
        f"{label} shows no surface in the object box (x {box.x_min_m:g} to {box.x_max_m:g} m, y"
        f" {box.y_min_m:g} to {box.y_max_m:g} m): it lies outside, is edge on, or is smaller than a"
        " cell; change x_m, y_m, size_m or its angles"
    )


def _turn_and_scale(triangles: Float64, pose: Pose) -> Float64:
    """Return the corners (3 n, 3), turned and scaled about their middle."""
    from trimesh.transformations import euler_matrix

    # x, then y, then z about fixed axes: the matrix is Rz Ry Rx.
    turn = euler_matrix(pose.tilt_x_rad, pose.tilt_y_rad, pose.turn_z_rad)[:3, :3]
    points = triangles.reshape(-1, 3) @ turn.T
    points = points - (points.min(0) + points.max(0)) / 2
    # Depth does not count: size is what the wall sees.
    points *= pose.size_m / np.ptp(points[:, :2], axis=0).max()
    return points


def _room_m(pose: Pose, box: ObjectBox) -> float:
    room_m = box.z_far_m - box.z_near_m - pose.front_m
    if room_m < 0:
        depth_m = room_m + pose.front_m
        raise SceneError(
            f"front_m of {pose.front_m:g} m leaves the box, which is {depth_m:g} m deep: lower it"
        )
    return room_m


def pose_from_units(units: Sequence[float], box: ObjectBox) -> Pose:
    """Return the pose that seven numbers in [0, 1] decide; it keeps the whole object in the box.

    In turn: size (55 to 90 % of the box), tilts (to 15 and 20 degrees), turn (to 35), offsets, and
    distance (the object's front is in the nearest 35 % of the box). Random poses are uniform over
    all of these.
    """
    size, tilt_x, tilt_y, turn_z, right, up, front = units
    width_m = box_width_m(box)
    size_m = width_m * (0.55 + 0.35 * size)
    # Offsets within half of what the object leaves free: it stays inside the box.
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


def box_width_m(box: ObjectBox) -> float:
    """Return the smaller of the box's extents along x and y."""
    return min(box.x_max_m - box.x_min_m, box.y_max_m - box.y_min_m)


def random_pose(generator: np.random.Generator, box: ObjectBox) -> Pose:
    """Return a pose that keeps the whole object in the box, uniform over the poses of
    `pose_from_units`.
    """
    return pose_from_units(generator.random(POSE_UNITS).tolist(), box)


def object_depth(
    seed: int, box: ObjectBox, categories: Sequence[str] | None = None, *, backgrounds: float = 0.0
) -> tuple[str, Float32]:
    """Return one random object, by the seed alone: its category and its depth map (64, 64) in
    metres, NaN background.

    `categories` are those to choose from (default: all). `backgrounds` is the share of objects with
    a post or a panel beside them; the objects themselves do not depend on it. Raises SceneError for
    no or an unknown category.
    """
    names = [
        find_category(name).name for name in (CATEGORIES if categories is None else categories)
    ]
    if not names:
        raise SceneError(f"no object category is left: choose from {', '.join(CATEGORIES)}")
    # The order of draws is part of the data sets: category, shape, pose, and background last.
    generator = np.random.default_rng([seed, OBJECT_PIXELS])
    category = str(generator.choice(names))
    triangles = category_triangles(category, int(generator.integers(2**31)))
    depth_m = orthographic_depth(place(triangles, random_pose(generator, box), box), box)
    if generator.random() < backgrounds:
        depth_m = add_background(depth_m, box, generator)
    return category, depth_m
