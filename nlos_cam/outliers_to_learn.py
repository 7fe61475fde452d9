"""Kinds of outliers that a doubt network learns from."""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from nlos_calibration.arrays import Float32

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.placement import post, random_pose
from nlos_cam.render.material import Surface
from nlos_cam.sights import Generator, Kind, Sight, ordinary, placed, smooth_pattern, width_m
from nlos_cam.varied_bench import moved


def small(generator: Generator, sight: Sight) -> Sight:
    """A thing of 15 to 35 % of the box."""
    box = object_box(sight.rig)
    size_m, (right, up) = width_m(box) * generator.uniform(0.15, 0.35), generator.uniform(-0.3, 0.3, 2) * width_m(box)
    return replace(sight, depth_m=placed(generator, box, size_m=size_m, x_m=right, y_m=up))


def large(generator: Generator, sight: Sight) -> Sight:
    """A thing of 125 to 180 % of the box, whose sides are cut off."""
    box = object_box(sight.rig)
    return replace(sight, depth_m=placed(generator, box, size_m=width_m(box) * generator.uniform(1.25, 1.8)))


def far(generator: Generator, sight: Sight) -> Sight:
    """A thing 0.12 to 0.35 m farther from the wall, most of it beyond the box."""
    return replace(sight, depth_m=placed(generator, object_box(sight.rig)) + np.float32(generator.uniform(0.12, 0.35)))


def near(generator: Generator, sight: Sight) -> Sight:
    """A thing that stands out of the box, 40 to 90 mm nearer to the wall."""
    box = object_box(sight.rig)
    depth_m = placed(generator, box, front_m=0.0) - np.float32(generator.uniform(0.04, 0.09))
    return replace(sight, depth_m=depth_m)


def half_out(generator: Generator, sight: Sight) -> Sight:
    """A thing of ordinary size, 35 to 60 % of which lies beside the box."""
    box = object_box(sight.rig)
    pose = random_pose(generator, box)
    out_m = (width_m(box) + pose.size_m) / 2 - pose.size_m * generator.uniform(0.4, 0.65)
    angle = np.radians(90) * int(generator.integers(4))
    return replace(sight, depth_m=placed(generator, box, x_m=out_m * np.cos(angle), y_m=out_m * np.sin(angle)))


def several(generator: Generator, sight: Sight) -> Sight:
    """Two or three things apart from each other."""
    box = object_box(sight.rig)
    count, start = int(generator.integers(2, 4)), generator.uniform(0, 2 * np.pi)
    depths_m = list[Float32]()
    for k in range(count):
        angle, reach_m = start + 2 * np.pi * k / count, 0.3 * width_m(box)
        x_m, y_m = reach_m * np.cos(angle), reach_m * np.sin(angle)
        size_m = width_m(box) * generator.uniform(0.25, 0.4)
        front_m = generator.uniform(0, 0.6) * (box.z_far_m - box.z_near_m)
        depths_m.append(placed(generator, box, size_m=size_m, x_m=x_m, y_m=y_m, front_m=front_m))
    return replace(sight, depth_m=np.fmin.reduce(depths_m))


def blobs(generator: Generator, sight: Sight) -> Sight:
    """Smooth random shapes of smooth random depth."""
    box = object_box(sight.rig)
    covered = smooth_pattern(generator, int(generator.integers(3, 9))) > generator.uniform(0.35, 0.75)
    share = smooth_pattern(generator, int(generator.integers(3, 9))) * generator.uniform(0.3, 1.0)
    depth_m = box.z_near_m + share * np.float32(box.z_far_m - box.z_near_m)
    return replace(sight, depth_m=np.where(covered, depth_m, np.float32(np.nan)))


def dim(generator: Generator, sight: Sight) -> Sight:
    """A grey or black thing: 5 to 40 % of a white one's light."""
    return replace(ordinary(generator, sight), surface=Surface(float(generator.uniform(0.05, 0.4))))


def posts(generator: Generator, sight: Sight) -> Sight:
    """A thing on a post, with another above it."""
    depth_m = placed(generator, object_box(sight.rig))
    for _ in range(2):
        depth_m = np.where(np.isnan(depth_m), post(depth_m, generator), depth_m)[::-1]
    return replace(sight, depth_m=np.ascontiguousarray(depth_m))


def tilted(generator: Generator, sight: Sight) -> Sight:
    """A thing tilted by 40 to 75 degrees, up or down and to a side."""
    tilts = np.radians(generator.uniform(40, 75, 2)) * generator.choice([-1, 1], 2)
    pose = {"tilt_x_rad": float(tilts[0]), "tilt_y_rad": float(tilts[1])}
    return replace(sight, depth_m=placed(generator, object_box(sight.rig), **pose))


def plates(generator: Generator, sight: Sight) -> Sight:
    """A large slanted plate without any relief."""
    box, steps = object_box(sight.rig), np.linspace(-0.5, 0.5, OBJECT_PIXELS)
    x, y = np.meshgrid(steps, -steps)
    slope_x, slope_y = generator.uniform(-1, 1, 2)
    depth_m = generator.uniform(box.z_near_m, 0.8 * box.z_far_m) + width_m(box) * (slope_x * x + slope_y * y)
    half_x, half_y = generator.uniform(0.3, 0.5, 2)
    covered = (abs(x) < half_x) & (abs(y) < half_y) & (depth_m > 0.5 * box.z_near_m)
    return replace(sight, depth_m=np.where(covered, depth_m, np.nan).astype(np.float32))


def other_rig(generator: Generator, sight: Sight) -> Sight:
    """An ordinary thing seen by a lidar that stands 15 to 50 mm off, turned by 2 to 8 degrees."""
    signs = generator.choice([-1, 1], 3)
    place_m, yaw, pitch = signs * generator.uniform([0.015, 2, 2], [0.05, 8, 8])
    return replace(ordinary(generator, sight), rig=moved(sight.rig, place_m, yaw, pitch))


def other_sensor(generator: Generator, sight: Sight) -> Sight:
    """An ordinary thing seen with a third to two thirds of the gain, or half as much again to three times it."""
    gain = float(generator.choice([generator.uniform(0.3, 0.65), generator.uniform(1.6, 3.0)]))
    sensor = sight.sensor.model_copy(update={"bare_wall_counts": sight.sensor.bare_wall_counts * gain})
    return replace(ordinary(generator, sight), sensor=sensor)


def warped(generator: Generator, sight: Sight) -> Sight:
    """A thing bent out of shape: every pixel is taken from up to a sixth of the box away, smoothly."""
    whole_m, steps = placed(generator, object_box(sight.rig)), np.arange(OBJECT_PIXELS, dtype=np.float32)
    x, y = np.meshgrid(steps, steps)
    off = [(smooth_pattern(generator, 5) - np.float32(0.5)) * np.float32(OBJECT_PIXELS / 3) for _ in range(2)]
    bent = cv2.remap(whole_m, x + off[0], y + off[1], cv2.INTER_NEAREST, borderValue=float("nan"))
    return replace(sight, depth_m=bent.astype(np.float32))


def inside_out(generator: Generator, sight: Sight) -> Sight:
    """A thing whose far parts are near and whose near parts are far, and twice as deep."""
    box = object_box(sight.rig)
    whole_m = placed(generator, box)
    depth_m = np.nanmin(whole_m) + 2 * (np.nanmax(whole_m) - whole_m)
    return replace(sight, depth_m=np.minimum(depth_m, np.float32(1.5 * box.z_far_m)))


def cut_out(generator: Generator, sight: Sight) -> Sight:
    """The silhouette of a thing, flat, with holes in it."""
    whole_m = placed(generator, object_box(sight.rig))
    holes = smooth_pattern(generator, int(generator.integers(4, 10))) > generator.uniform(0.45, 0.75)
    flat = np.where(holes | np.isnan(whole_m), np.nan, np.nanmedian(whole_m))
    return replace(sight, depth_m=flat.astype(np.float32))


def scrambled(generator: Generator, sight: Sight) -> Sight:
    """A thing cut into 3 x 3 or 4 x 4 tiles, which are shuffled."""
    whole_m, n = placed(generator, object_box(sight.rig)), int(generator.choice([3, 4]))
    side = OBJECT_PIXELS // n
    tiles = [whole_m[i * side : (i + 1) * side, j * side : (j + 1) * side] for i in range(n) for j in range(n)]
    order = generator.permutation(n * n)
    mixed_m = np.block([[tiles[order[i * n + j]] for j in range(n)] for i in range(n)])
    margin = OBJECT_PIXELS - n * side
    return replace(sight, depth_m=np.pad(mixed_m, (0, margin), constant_values=np.nan).astype(np.float32))


TO_LEARN: Mapping[str, Kind] = {
    kind.__name__.replace("_", " "): kind
    for kind in (
        *(small, large, far, near, half_out, several, blobs, dim, posts, tilted, plates, other_rig, other_sensor),
        *(warped, inside_out, cut_out, scrambled),
    )
}
