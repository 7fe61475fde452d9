"""What a lidar may be shown that no training object is: kinds of outliers, some to learn from, the others to judge by.

Training's objects are whole, of one piece, of 55 to 90 % of the box, with their front in its nearest third, white and
matt. A kind to judge by is never learnt from, so that what is unlike anything seen before is judged, too.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import radians

import cv2
import numpy as np
import trimesh
from nlos_calibration.rig import ObjectBox, Rig
from trimesh.transformations import euler_matrix

from nlos_cam.frames import OBJECT_PIXELS, Float32
from nlos_cam.objects.backgrounds import panel, post
from nlos_cam.objects.categories import CATEGORIES
from nlos_cam.objects.depth_image import object_box
from nlos_cam.objects.hidden import Pose, category_triangles, place, random_pose
from nlos_cam.objects.raster import orthographic_depth
from nlos_cam.objects.solids import Triangles
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor_model import SensorModel
from nlos_cam.render.surface import Surface, phong, retroreflective
from nlos_cam.varied_bench import moved

Generator = np.random.Generator
LOBES = phong(0.1, 0.9, 80.0), retroreflective(0.1, 0.9, 80.0)
"""Made once: each is compiled."""
LEAST_PIXELS = 12
"""An outlier of fewer pixels is made again: too little to be hidden."""


@dataclass(frozen=True)
class Sight:
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


Kind = Callable[[Generator, Sight], Sight]
"""Makes an outlier of a sight that is ordinary, but for its object, which is still to come."""


def _triangles(generator: Generator) -> Triangles:
    return category_triangles(str(generator.choice(list(CATEGORIES))), int(generator.integers(2**31)))


def _placed(generator: Generator, box: ObjectBox, **pose: float) -> Float32:
    """A thing of any category in a pose that is random but for what is given."""
    drawn = replace(random_pose(generator, box), **pose)
    return orthographic_depth(place(_triangles(generator), drawn, box), box)


def _width_m(box: ObjectBox) -> float:
    return min(box.x_max_m - box.x_min_m, box.y_max_m - box.y_min_m)


def ordinary(generator: Generator, sight: Sight) -> Sight:
    """A thing as training has them."""
    return replace(sight, depth_m=_placed(generator, object_box(sight.rig)))


def small(generator: Generator, sight: Sight) -> Sight:
    """A thing of 15 to 35 % of the box."""
    box = object_box(sight.rig)
    size_m, (right, up) = _width_m(box) * generator.uniform(0.15, 0.35), generator.uniform(-0.3, 0.3, 2) * _width_m(box)
    return replace(sight, depth_m=_placed(generator, box, size_m=size_m, x_m=right, y_m=up))


def large(generator: Generator, sight: Sight) -> Sight:
    """A thing of 125 to 180 % of the box, whose sides are cut off."""
    box = object_box(sight.rig)
    return replace(sight, depth_m=_placed(generator, box, size_m=_width_m(box) * generator.uniform(1.25, 1.8)))


def far(generator: Generator, sight: Sight) -> Sight:
    """A thing 0.12 to 0.35 m farther from the wall, most of it beyond the box."""
    return replace(sight, depth_m=_placed(generator, object_box(sight.rig)) + np.float32(generator.uniform(0.12, 0.35)))


def several(generator: Generator, sight: Sight) -> Sight:
    """Two or three things apart from each other."""
    box = object_box(sight.rig)
    count, start = int(generator.integers(2, 4)), generator.uniform(0, 2 * np.pi)
    depths_m = list[Float32]()
    for k in range(count):
        angle, reach_m = start + 2 * np.pi * k / count, 0.3 * _width_m(box)
        x_m, y_m = reach_m * np.cos(angle), reach_m * np.sin(angle)
        size_m = _width_m(box) * generator.uniform(0.25, 0.4)
        front_m = generator.uniform(0, 0.6) * (box.z_far_m - box.z_near_m)
        depths_m.append(_placed(generator, box, size_m=size_m, x_m=x_m, y_m=y_m, front_m=front_m))
    return replace(sight, depth_m=np.fmin.reduce(depths_m))


def _smooth(generator: Generator, across: int) -> Float32:
    """A smooth random pattern (64, 64) from 0 to 1."""
    coarse = generator.standard_normal((across, across)).astype(np.float32)
    pattern = cv2.resize(coarse, (OBJECT_PIXELS, OBJECT_PIXELS), interpolation=cv2.INTER_CUBIC)
    return ((pattern - pattern.min()) / np.ptp(pattern)).astype(np.float32)


def blobs(generator: Generator, sight: Sight) -> Sight:
    """Smooth random shapes of smooth random depth."""
    box = object_box(sight.rig)
    covered = _smooth(generator, int(generator.integers(3, 9))) > generator.uniform(0.35, 0.75)
    share = _smooth(generator, int(generator.integers(3, 9))) * generator.uniform(0.3, 1.0)
    depth_m = box.z_near_m + share * np.float32(box.z_far_m - box.z_near_m)
    return replace(sight, depth_m=np.where(covered, depth_m, np.float32(np.nan)))


def dim(generator: Generator, sight: Sight) -> Sight:
    """A grey or black thing: 5 to 40 % of a white one's light."""
    return replace(ordinary(generator, sight), surface=Surface(float(generator.uniform(0.05, 0.4))))


def posts(generator: Generator, sight: Sight) -> Sight:
    """A thing on a post, with another above it."""
    depth_m = _placed(generator, object_box(sight.rig))
    for _ in range(2):
        depth_m = np.where(np.isnan(depth_m), post(depth_m, generator), depth_m)[::-1]
    return replace(sight, depth_m=np.ascontiguousarray(depth_m))


def tilted(generator: Generator, sight: Sight) -> Sight:
    """A thing tilted by 40 to 75 degrees, up or down and to a side."""
    tilts = np.radians(generator.uniform(40, 75, 2)) * generator.choice([-1, 1], 2)
    pose = {"tilt_x_rad": float(tilts[0]), "tilt_y_rad": float(tilts[1])}
    return replace(sight, depth_m=_placed(generator, object_box(sight.rig), **pose))


def plates(generator: Generator, sight: Sight) -> Sight:
    """A large slanted plate without any relief."""
    box, steps = object_box(sight.rig), np.linspace(-0.5, 0.5, OBJECT_PIXELS)
    x, y = np.meshgrid(steps, -steps)
    slope_x, slope_y = generator.uniform(-1, 1, 2)
    depth_m = generator.uniform(box.z_near_m, 0.8 * box.z_far_m) + _width_m(box) * (slope_x * x + slope_y * y)
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


def panels(generator: Generator, sight: Sight) -> Sight:
    """A thing before a panel that fills most of the box."""
    box = object_box(sight.rig)
    depth_m = _placed(generator, box)
    return replace(sight, depth_m=np.where(np.isnan(depth_m), panel(depth_m, box, generator), depth_m))


def noise_sheet(generator: Generator, sight: Sight) -> Sight:
    """A sheet whose every pixel lies elsewhere in the box."""
    box = object_box(sight.rig)
    depth_m = generator.uniform(box.z_near_m, box.z_far_m, (OBJECT_PIXELS, OBJECT_PIXELS))
    depth_m[generator.random(depth_m.shape) < generator.uniform(0, 0.5)] = np.nan
    return replace(sight, depth_m=depth_m.astype(np.float32))


def bars(generator: Generator, sight: Sight) -> Sight:
    """A cage: parallel bars, upright or lying, with gaps between them."""
    box, period = object_box(sight.rig), int(generator.integers(10, 24))
    at = (np.arange(OBJECT_PIXELS) + int(generator.integers(period))) % period < max(2, period // 4)
    depth_m = np.where(at, generator.uniform(box.z_near_m, 0.7 * box.z_far_m), np.nan).astype(np.float32)
    sheet = np.ascontiguousarray(np.broadcast_to(depth_m, (OBJECT_PIXELS, OBJECT_PIXELS)))
    return replace(sight, depth_m=sheet if generator.random() < 0.5 else np.ascontiguousarray(sheet.T))


def rings(generator: Generator, sight: Sight) -> Sight:
    """A torus that is turned any way."""
    box = object_box(sight.rig)
    ring = trimesh.creation.torus(1.0, generator.uniform(0.15, 0.35), major_sections=32, minor_sections=16)
    turn = euler_matrix(*np.radians(generator.uniform(-60, 60, 3)))[:3, :3]
    pose = Pose(size_m=_width_m(box) * generator.uniform(0.55, 0.9), front_m=generator.uniform(0, 0.1))
    return replace(sight, depth_m=orthographic_depth(place(np.asarray(ring.triangles) @ turn.T, pose, box), box))


def glossy(generator: Generator, sight: Sight) -> Sight:
    """A mirror-like thing, or one that sends light back to where it came from."""
    return replace(ordinary(generator, sight), surface=Surface(1.0, LOBES[int(generator.integers(2))]))


def near(generator: Generator, sight: Sight) -> Sight:
    """A thing that stands out of the box, 40 to 90 mm nearer to the wall."""
    box = object_box(sight.rig)
    depth_m = _placed(generator, box, front_m=0.0) - np.float32(generator.uniform(0.04, 0.09))
    return replace(sight, depth_m=depth_m)


def half_out(generator: Generator, sight: Sight) -> Sight:
    """A thing of ordinary size, 35 to 60 % of which lies beside the box."""
    box = object_box(sight.rig)
    pose = random_pose(generator, box)
    out_m = (_width_m(box) + pose.size_m) / 2 - pose.size_m * generator.uniform(0.4, 0.65)
    angle = radians(90) * int(generator.integers(4))
    return replace(sight, depth_m=_placed(generator, box, x_m=out_m * np.cos(angle), y_m=out_m * np.sin(angle)))


def two_tone(generator: Generator, sight: Sight) -> Sight:
    """A thing of which one half is nearly black."""
    seen = ordinary(generator, sight)
    dark = _smooth(generator, 3) > 0.5
    return replace(seen, surface=Surface(np.where(dark, 0.05, 1.0)))


TO_LEARN: Mapping[str, Kind] = {
    kind.__name__.replace("_", " "): kind
    for kind in (small, large, far, several, blobs, dim, posts, tilted, plates, other_rig, other_sensor)
}
TO_JUDGE: Mapping[str, Kind] = {
    kind.__name__.replace("_", " "): kind
    for kind in (panels, noise_sheet, bars, rings, glossy, near, half_out, two_tone)
}


def outlier(kind: Kind, generator: Generator, sight: Sight) -> Sight:
    """One outlier of a kind that shows some surface."""
    while True:
        made = kind(generator, sight)
        if made.depth_m is not None and np.isfinite(made.depth_m).sum() >= LEAST_PIXELS:
            return made
