"""What a lidar may be shown that no training object is: kinds of outliers, some to learn from, the others to judge by.

Training's objects are whole, of one piece, of 55 to 90 % of the box, with their front in its nearest third, white and
matt. A kind to judge by is never learnt from, so that what is unlike anything seen before is judged, too.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import trimesh
from trimesh.transformations import euler_matrix

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import object_box, orthographic_depth
from nlos_cam.objects.placement import Pose, panel, place
from nlos_cam.outliers_to_learn import TO_LEARN
from nlos_cam.render.material import Surface, phong, retroreflective
from nlos_cam.sights import Generator, Kind, Sight, ordinary, placed, smooth_pattern, width_m

__all__ = ["IN_SHAPE", "TO_JUDGE", "TO_LEARN", "outlier"]

LOBES = phong(0.1, 0.9, 80.0), retroreflective(0.1, 0.9, 80.0)
"""Made once: each is compiled."""
LEAST_PIXELS = 12
"""An outlier of fewer pixels is made again: too little to be hidden."""


def panels(generator: Generator, sight: Sight) -> Sight:
    """A thing before a panel that fills most of the box."""
    box = object_box(sight.rig)
    depth_m = placed(generator, box)
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
    pose = Pose(size_m=width_m(box) * generator.uniform(0.55, 0.9), front_m=generator.uniform(0, 0.1))
    return replace(sight, depth_m=orthographic_depth(place(np.asarray(ring.triangles) @ turn.T, pose, box), box))


def glossy(generator: Generator, sight: Sight) -> Sight:
    """A mirror-like thing, or one that sends light back to where it came from."""
    return replace(ordinary(generator, sight), surface=Surface(1.0, LOBES[int(generator.integers(2))]))


def two_tone(generator: Generator, sight: Sight) -> Sight:
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


def outlier(kind: Kind, generator: Generator, sight: Sight) -> Sight:
    """One outlier of a kind that shows some surface."""
    while True:
        made = kind(generator, sight)
        if made.depth_m is not None and np.isfinite(made.depth_m).sum() >= LEAST_PIXELS:
            return made
