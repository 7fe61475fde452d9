"""What the lidar is shown, on which rig, by which sensor; and ordinary things, of which outliers are made."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.rig import ObjectBox, Rig

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import object_box, orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import category_triangles, place, random_pose
from nlos_cam.render.material import Surface
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor.model import SensorModel

Generator = np.random.Generator


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


def ordinary(generator: Generator, sight: Sight) -> Sight:
    """A thing as training has them."""
    return replace(sight, depth_m=placed(generator, object_box(sight.rig)))
