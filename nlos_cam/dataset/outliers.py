"""What a lidar may be shown that no training object is: kinds of outliers, some to learn from, the others to judge by.

Training's objects are whole, of one piece, of 55 to 90 % of the box, with their front in its nearest third, white and
matt. A kind to judge by is never learnt from, so that what is unlike anything seen before is judged, too.

What the lidar is shown, on which rig, by which sensor; and ordinary things, of which outliers are made.

Benches near the one that networks were trained for: a lidar that stands a little off, other light, biased depth.

Kinds of outliers that a doubt network learns from.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32, Float64
from trimesh.transformations import euler_matrix

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects import (
    CATEGORIES,
    Pose,
    category_triangles,
    object_box,
    orthographic_depth,
    panel,
    place,
    post,
    random_pose,
)
from nlos_cam.render import Scene, SensorModel, Surface, phong, retroreflective

Generator = np.random.Generator


@dataclass(frozen=True)
class Stimulus:
    """What the lidar is shown, on which rig, and by which sensor it is seen."""

    rig: Rig
    sensor: SensorModel
    depth_m: Float32 | None = None
    """(64, 64), NaN for background; None hides nothing."""
    surface: Surface = field(default_factory=Surface)

    @property
    def scene(self) -> Scene:
        """What is rendered."""
        return Scene(self.rig, self.depth_m, self.surface, pulse_ns=self.sensor.pulse_ns)


Kind = Callable[[Generator, Stimulus], Stimulus]
"""Makes an outlier of a sight that is ordinary, but for its object, which is still to come."""


def _triangles(generator: Generator) -> Float64:
    return category_triangles(str(generator.choice(list(CATEGORIES))), int(generator.integers(2**31)))


def placed(generator: Generator, box: ObjectBox, **pose: float) -> Float32:
    """A thing of any category in a pose that is random but for what is given."""
    drawn = replace(random_pose(generator, box), **pose)
    return orthographic_depth(place(_triangles(generator), drawn, box), box)


def width_m(box: ObjectBox) -> float:
    return min(box.x_max_m - box.x_min_m, box.y_max_m - box.y_min_m)


def smooth_pattern(generator: Generator, across: int) -> Float32:
    """A smooth random pattern (64, 64) from 0 to 1."""
    coarse = generator.standard_normal((across, across)).astype(np.float32)
    pattern = cv2.resize(coarse, (OBJECT_PIXELS, OBJECT_PIXELS), interpolation=cv2.INTER_CUBIC)
    return ((pattern - pattern.min()) / np.ptp(pattern)).astype(np.float32)


def ordinary(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing as training has them."""
    return replace(sight, depth_m=placed(generator, object_box(sight.rig)))


class Spread(NamedTuple):
    """How far a bench may lie from the given one; each is drawn evenly up to it."""

    place_m: float
    angle_deg: float
    gain: float
    """Of the logarithm of the counts, to either side."""
    ambient_counts: float
    offset_m: float
    ripple_m: float
    patch_m: float
    texture: float


SLIGHT = Spread(0.0005, 0.1, 0.05, 10.0, 0.001, 0.0005, 0.0003, 0.03)
"""What a good calibration leaves: objects look as they did."""
WIDE = Spread(0.004, 0.6, 0.7, 60.0, 0.006, 0.003, 0.002, 0.2)
"""What an empty bench may do without showing an object."""
WITHOUT_OCCLUDER = 0.1
"""Of wide benches, the share that has no occluder: a wall alone hides nothing."""


def moved(rig: Rig, place_m: float, yaw_deg: float, pitch_deg: float) -> Rig:
    """The rig with its lidar so much farther from the wall, and turned by so much."""
    lidar = rig.lidar.model_copy(
        update={
            "distance_m": rig.lidar.distance_m + place_m,
            "yaw_deg": rig.lidar.yaw_deg + yaw_deg,
            "pitch_deg": rig.lidar.pitch_deg + pitch_deg,
        }
    )
    return rig.model_copy(update={"lidar": lidar})


def varied(rig: Rig, sensor: SensorModel, spread: Spread, generator: Generator) -> tuple[Rig, SensorModel]:
    """A bench near the given one."""
    place, yaw, pitch, gain, offset = generator.uniform(-1, 1, 5).tolist()
    ambient, ripple, patch, texture = generator.uniform(0, 1, 4).tolist()
    changed = sensor.model_copy(
        update={
            "bare_wall_counts": sensor.bare_wall_counts * float(np.exp(gain * spread.gain)),
            "ambient_counts": ambient * spread.ambient_counts,
            "range_offset_m": offset * spread.offset_m,
            "ripple_m": ripple * spread.ripple_m,
            "patch_drift_m": patch * spread.patch_m,
            "wall_texture": texture * spread.texture,
        }
    )
    angles = yaw * spread.angle_deg, pitch * spread.angle_deg
    return moved(rig, place * spread.place_m, *angles), changed


def varied_empty(rig: Rig, sensor: SensorModel, generator: Generator) -> tuple[Rig, SensorModel]:
    """A bench with nothing hidden: from the given one to one that lies widely off, and some without an occluder."""
    share = float(generator.choice([0.0, generator.random(), 1.0]))
    spread = Spread(*(share * most for most in WIDE))
    bench, seen_by = varied(rig, sensor, spread, generator)
    if generator.random() < WITHOUT_OCCLUDER:
        bench = bench.model_copy(update={"occluder": None})
    return bench, seen_by


def small(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing of 15 to 35 % of the box."""
    box = object_box(sight.rig)
    size_m, (right, up) = width_m(box) * generator.uniform(0.15, 0.35), generator.uniform(-0.3, 0.3, 2) * width_m(box)
    return replace(sight, depth_m=placed(generator, box, size_m=size_m, x_m=right, y_m=up))


def large(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing of 125 to 180 % of the box, whose sides are cut off."""
    box = object_box(sight.rig)
    return replace(sight, depth_m=placed(generator, box, size_m=width_m(box) * generator.uniform(1.25, 1.8)))


def far(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing 0.12 to 0.35 m farther from the wall, most of it beyond the box."""
    return replace(sight, depth_m=placed(generator, object_box(sight.rig)) + np.float32(generator.uniform(0.12, 0.35)))


def near(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing that stands out of the box, 40 to 90 mm nearer to the wall."""
    box = object_box(sight.rig)
    depth_m = placed(generator, box, front_m=0.0) - np.float32(generator.uniform(0.04, 0.09))
    return replace(sight, depth_m=depth_m)


def half_out(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing of ordinary size, 35 to 60 % of which lies beside the box."""
    box = object_box(sight.rig)
    pose = random_pose(generator, box)
    out_m = (width_m(box) + pose.size_m) / 2 - pose.size_m * generator.uniform(0.4, 0.65)
    angle = np.radians(90) * int(generator.integers(4))
    return replace(sight, depth_m=placed(generator, box, x_m=out_m * np.cos(angle), y_m=out_m * np.sin(angle)))


def several(generator: Generator, sight: Stimulus) -> Stimulus:
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


def blobs(generator: Generator, sight: Stimulus) -> Stimulus:
    """Smooth random shapes of smooth random depth."""
    box = object_box(sight.rig)
    covered = smooth_pattern(generator, int(generator.integers(3, 9))) > generator.uniform(0.35, 0.75)
    share = smooth_pattern(generator, int(generator.integers(3, 9))) * generator.uniform(0.3, 1.0)
    depth_m = box.z_near_m + share * np.float32(box.z_far_m - box.z_near_m)
    return replace(sight, depth_m=np.where(covered, depth_m, np.float32(np.nan)))


def dim(generator: Generator, sight: Stimulus) -> Stimulus:
    """A grey or black thing: 5 to 40 % of a white one's light."""
    return replace(ordinary(generator, sight), surface=Surface(float(generator.uniform(0.05, 0.4))))


def posts(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing on a post, with another above it."""
    depth_m = placed(generator, object_box(sight.rig))
    for _ in range(2):
        depth_m = np.where(np.isnan(depth_m), post(depth_m, generator), depth_m)[::-1]
    return replace(sight, depth_m=np.ascontiguousarray(depth_m))


def tilted(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing tilted by 40 to 75 degrees, up or down and to a side."""
    tilts = np.radians(generator.uniform(40, 75, 2)) * generator.choice([-1, 1], 2)
    pose = {"tilt_x_rad": float(tilts[0]), "tilt_y_rad": float(tilts[1])}
    return replace(sight, depth_m=placed(generator, object_box(sight.rig), **pose))


def plates(generator: Generator, sight: Stimulus) -> Stimulus:
    """A large slanted plate without any relief."""
    box, steps = object_box(sight.rig), np.linspace(-0.5, 0.5, OBJECT_PIXELS)
    x, y = np.meshgrid(steps, -steps)
    slope_x, slope_y = generator.uniform(-1, 1, 2)
    depth_m = generator.uniform(box.z_near_m, 0.8 * box.z_far_m) + width_m(box) * (slope_x * x + slope_y * y)
    half_x, half_y = generator.uniform(0.3, 0.5, 2)
    covered = (abs(x) < half_x) & (abs(y) < half_y) & (depth_m > 0.5 * box.z_near_m)
    return replace(sight, depth_m=np.where(covered, depth_m, np.nan).astype(np.float32))


def other_rig(generator: Generator, sight: Stimulus) -> Stimulus:
    """An ordinary thing seen by a lidar that stands 15 to 50 mm off, turned by 2 to 8 degrees."""
    signs = generator.choice([-1, 1], 3)
    place_m, yaw, pitch = signs * generator.uniform([0.015, 2, 2], [0.05, 8, 8])
    return replace(ordinary(generator, sight), rig=moved(sight.rig, place_m, yaw, pitch))


def other_sensor(generator: Generator, sight: Stimulus) -> Stimulus:
    """An ordinary thing seen with a third to two thirds of the gain, or half as much again to three times it."""
    gain = float(generator.choice([generator.uniform(0.3, 0.65), generator.uniform(1.6, 3.0)]))
    sensor = sight.sensor.model_copy(update={"bare_wall_counts": sight.sensor.bare_wall_counts * gain})
    return replace(ordinary(generator, sight), sensor=sensor)


def warped(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing bent out of shape: every pixel is taken from up to a sixth of the box away, smoothly."""
    whole_m, steps = placed(generator, object_box(sight.rig)), np.arange(OBJECT_PIXELS, dtype=np.float32)
    x, y = np.meshgrid(steps, steps)
    off = [(smooth_pattern(generator, 5) - np.float32(0.5)) * np.float32(OBJECT_PIXELS / 3) for _ in range(2)]
    bent = cv2.remap(whole_m, x + off[0], y + off[1], cv2.INTER_NEAREST, borderValue=float("nan"))
    return replace(sight, depth_m=bent.astype(np.float32))


def inside_out(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing whose far parts are near and whose near parts are far, and twice as deep."""
    box = object_box(sight.rig)
    whole_m = placed(generator, box)
    depth_m = np.nanmin(whole_m) + 2 * (np.nanmax(whole_m) - whole_m)
    return replace(sight, depth_m=np.minimum(depth_m, np.float32(1.5 * box.z_far_m)))


def cut_out(generator: Generator, sight: Stimulus) -> Stimulus:
    """The silhouette of a thing, flat, with holes in it."""
    whole_m = placed(generator, object_box(sight.rig))
    holes = smooth_pattern(generator, int(generator.integers(4, 10))) > generator.uniform(0.45, 0.75)
    flat = np.where(holes | np.isnan(whole_m), np.nan, np.nanmedian(whole_m))
    return replace(sight, depth_m=flat.astype(np.float32))


def scrambled(generator: Generator, sight: Stimulus) -> Stimulus:
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


__all__ = ["IN_SHAPE", "TO_JUDGE", "TO_LEARN", "outlier"]

LOBES = phong(0.1, 0.9, 80.0), retroreflective(0.1, 0.9, 80.0)
"""Made once: each is compiled."""
MIN_PIXELS = 12
"""An outlier of fewer pixels is made again: too little to be hidden."""


def panels(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing before a panel that fills most of the box."""
    box = object_box(sight.rig)
    depth_m = placed(generator, box)
    return replace(sight, depth_m=np.where(np.isnan(depth_m), panel(depth_m, box, generator), depth_m))


def noise_sheet(generator: Generator, sight: Stimulus) -> Stimulus:
    """A sheet whose every pixel lies elsewhere in the box."""
    box = object_box(sight.rig)
    depth_m = generator.uniform(box.z_near_m, box.z_far_m, (OBJECT_PIXELS, OBJECT_PIXELS))
    depth_m[generator.random(depth_m.shape) < generator.uniform(0, 0.5)] = np.nan
    return replace(sight, depth_m=depth_m.astype(np.float32))


def bars(generator: Generator, sight: Stimulus) -> Stimulus:
    """A cage: parallel bars, upright or lying, with gaps between them."""
    box, period = object_box(sight.rig), int(generator.integers(10, 24))
    at = (np.arange(OBJECT_PIXELS) + int(generator.integers(period))) % period < max(2, period // 4)
    depth_m = np.where(at, generator.uniform(box.z_near_m, 0.7 * box.z_far_m), np.nan).astype(np.float32)
    sheet = np.ascontiguousarray(np.broadcast_to(depth_m, (OBJECT_PIXELS, OBJECT_PIXELS)))
    return replace(sight, depth_m=sheet if generator.random() < 0.5 else np.ascontiguousarray(sheet.T))


def rings(generator: Generator, sight: Stimulus) -> Stimulus:
    """A torus that is turned any way."""
    box = object_box(sight.rig)
    ring = trimesh.creation.torus(1.0, generator.uniform(0.15, 0.35), major_sections=32, minor_sections=16)
    turn = euler_matrix(*np.radians(generator.uniform(-60, 60, 3)))[:3, :3]
    pose = Pose(size_m=width_m(box) * generator.uniform(0.55, 0.9), front_m=generator.uniform(0, 0.1))
    return replace(sight, depth_m=orthographic_depth(place(np.asarray(ring.triangles) @ turn.T, pose, box), box))


def glossy(generator: Generator, sight: Stimulus) -> Stimulus:
    """A mirror-like thing, or one that sends light back to where it came from."""
    return replace(ordinary(generator, sight), surface=Surface(1.0, LOBES[int(generator.integers(2))]))


def two_tone(generator: Generator, sight: Stimulus) -> Stimulus:
    """A thing of which one half is nearly black."""
    seen = ordinary(generator, sight)
    dark = smooth_pattern(generator, 3) > 0.5
    return replace(seen, surface=Surface(np.where(dark, 0.05, 1.0)))


TO_JUDGE: Mapping[str, Kind] = {
    kind.__name__.replace("_", " "): kind for kind in (panels, noise_sheet, bars, rings, glossy, two_tone)
}

IN_SHAPE = frozenset(
    (
        "blobs",
        "posts",
        "plates",
        "warped",
        "inside out",
        "cut out",
        "scrambled",
        "panels",
        "noise sheet",
        "bars",
        "rings",
    )
)
"""Kinds that are unlike training in their shape alone. All others are out of its range: of size, place, tilt, number,
light, rig or sensor."""


def outlier(kind: Kind, generator: Generator, sight: Stimulus) -> Stimulus:
    """One outlier of a kind that shows some surface."""
    while True:
        made = kind(generator, sight)
        if made.depth_m is not None and np.isfinite(made.depth_m).sum() >= MIN_PIXELS:
            return made
