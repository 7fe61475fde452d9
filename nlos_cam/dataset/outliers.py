"""Outliers: stimuli unlike the training objects, and variations of a bench, for the uncertainty
network.

Training objects are of one piece, 55 to 90 % of the box wide, in its nearest third, white and matt.
Kinds of outliers are either in the training set or held out from it, so that the evaluation also
covers kinds the network has not met.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32
from trimesh.transformations import euler_matrix

from nlos_cam import objects as shapes
from nlos_cam.dataset.plan import move_lidar
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.render import Scene, SensorModel, Surface, phong, retroreflective

Generator = np.random.Generator


@dataclass(frozen=True)
class Stimulus:
    """Stimulus of the lidar: the hidden object and its surface, the rig, and the sensor."""

    rig: Rig
    sensor: SensorModel
    depth_m: Float32 | None = None
    """(64, 64), NaN for background; None for an empty bench."""
    surface: Surface = field(default_factory=Surface)

    @property
    def box(self) -> ObjectBox:
        """The rig's object box."""
        return shapes.object_box(self.rig)

    @property
    def scene(self) -> Scene:
        """The scene to render."""
        return Scene(self.rig, self.depth_m, self.surface, pulse_ns=self.sensor.pulse_ns)


OutlierKind = Callable[[Generator, Stimulus], Stimulus]
"""Makes an outlier from an ordinary stimulus that has no object yet."""


def hides(shape: Callable[[Generator, ObjectBox], Float32]) -> OutlierKind:
    """Return the kind that hides a shape: a function of the box that returns its depth map."""

    @wraps(shape)
    def kind(generator: Generator, stimulus: Stimulus) -> Stimulus:
        return replace(stimulus, depth_m=shape(generator, stimulus.box))

    return kind


def draw_object(generator: Generator, box: ObjectBox, **pose: float) -> Float32:
    """Return the depth map of an object of any category in a random pose, except for the given
    values.
    """
    drawn = replace(shapes.random_pose(generator, box), **pose)
    category = str(generator.choice(list(shapes.CATEGORIES)))
    return shapes.orthographic_depth(
        shapes.place(
            shapes.category_triangles(category, int(generator.integers(2**31))), drawn, box
        ),
        box,
    )


def smooth_pattern(generator: Generator, across: int) -> Float32:
    """Return a smooth random pattern (64, 64) from 0 to 1."""
    coarse = generator.standard_normal((across, across)).astype(np.float32)
    pattern = cv2.resize(coarse, (OBJECT_PIXELS, OBJECT_PIXELS), interpolation=cv2.INTER_CUBIC)
    return ((pattern - pattern.min()) / np.ptp(pattern)).astype(np.float32)


@hides
def ordinary(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object like those of the training set."""
    return draw_object(generator, box)


@hides
def generic(generator: Generator, box: ObjectBox) -> Float32:
    """Add a generic shape, as in training sets with a share of them."""
    return shapes.generic_depth(int(generator.integers(2**31)), box)[1]


class BenchSpread(NamedTuple):
    """Largest deviations of a bench from the given one; each is drawn uniformly."""

    place_m: float
    angle_deg: float
    gain: float
    """Of the logarithm of the counts, in either direction."""
    ambient_counts: float
    offset_m: float
    ripple_m: float
    patch_m: float
    texture: float


SLIGHT = BenchSpread(0.0005, 0.1, 0.05, 10.0, 0.001, 0.0005, 0.0003, 0.03)
"""Errors left by a good calibration, which do not change the look of objects."""
WIDE = BenchSpread(0.004, 0.6, 0.7, 60.0, 0.006, 0.003, 0.002, 0.2)
"""Deviations of an empty bench that must not look like an object."""
NO_OCCLUDER_SHARE = 0.1
"""Share of empty benches without an occluder: a bare wall."""
OFF_WALL_M = 0.01
"""Least distance of an object from the wall."""


def vary_bench(
    rig: Rig, sensor: SensorModel, spread: BenchSpread, generator: Generator
) -> tuple[Rig, SensorModel]:
    """Return a rig and a sensor near the given ones."""
    shift, yaw, pitch, gain, offset = generator.uniform(-1, 1, 5).tolist()
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
    return move_lidar(rig, shift * spread.place_m, *angles), changed


def vary_empty_bench(
    rig: Rig, sensor: SensorModel, generator: Generator
) -> tuple[Rig, SensorModel]:
    """Return the rig and the sensor of an empty bench: the given ones, wide deviations, some
    without an occluder.
    """
    share = float(generator.choice([0.0, generator.random(), 1.0]))
    spread = BenchSpread(*(share * limit for limit in WIDE))
    bench, model = vary_bench(rig, sensor, spread, generator)
    if generator.random() < NO_OCCLUDER_SHARE:
        bench = bench.model_copy(update={"occluder": None})
    return bench, model


@hides
def small(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object of 15 to 35 % of the box."""
    width_m = shapes.box_width_m(box)
    size_m = width_m * generator.uniform(0.15, 0.35)
    (x_m, y_m) = generator.uniform(-0.3, 0.3, 2) * width_m
    return draw_object(generator, box, size_m=size_m, x_m=x_m, y_m=y_m)


@hides
def large(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object of 125 to 180 % of the box, whose sides are cut off."""
    size_m = shapes.box_width_m(box) * generator.uniform(1.25, 1.8)
    return draw_object(generator, box, size_m=size_m)


@hides
def far(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object 0.12 to 0.35 m farther from the wall, most of it behind the box."""
    return draw_object(generator, box) + np.float32(generator.uniform(0.12, 0.35))


@hides
def near(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object that sticks out of the box, 40 to 90 mm nearer to the wall, as far as there is
    room before it.
    """
    depth_m = draw_object(generator, box, front_m=0.0)
    room_m = max(box.z_near_m - OFF_WALL_M, 0.0)
    return depth_m - np.float32(min(generator.uniform(0.04, 0.09), room_m))


@hides
def half_out(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object of ordinary size, 35 to 60 % of which lies beside the box."""
    pose = shapes.random_pose(generator, box)
    out_m = (shapes.box_width_m(box) + pose.size_m) / 2 - pose.size_m * generator.uniform(0.4, 0.65)
    angle = np.radians(90) * int(generator.integers(4))
    return draw_object(generator, box, x_m=out_m * np.cos(angle), y_m=out_m * np.sin(angle))


@hides
def several(generator: Generator, box: ObjectBox) -> Float32:
    """Add two or three separate objects."""
    count = int(generator.integers(2, 4))
    start = generator.uniform(0, 2 * np.pi)
    depths_m = list[Float32]()
    for k in range(count):
        angle = start + 2 * np.pi * k / count
        reach_m = 0.3 * shapes.box_width_m(box)
        x_m = reach_m * np.cos(angle)
        y_m = reach_m * np.sin(angle)
        size_m = shapes.box_width_m(box) * generator.uniform(0.25, 0.4)
        front_m = generator.uniform(0, 0.6) * (box.z_far_m - box.z_near_m)
        depths_m.append(
            draw_object(generator, box, size_m=size_m, x_m=x_m, y_m=y_m, front_m=front_m)
        )
    return np.fmin.reduce(depths_m)


@hides
def blobs(generator: Generator, box: ObjectBox) -> Float32:
    """Add smooth random shapes of smooth random depth."""
    covered = smooth_pattern(generator, int(generator.integers(3, 9))) > generator.uniform(
        0.35, 0.75
    )
    share = smooth_pattern(generator, int(generator.integers(3, 9))) * generator.uniform(0.3, 1.0)
    depth_m = box.z_near_m + share * np.float32(box.z_far_m - box.z_near_m)
    return np.where(covered, depth_m, np.float32(np.nan))


def dim(generator: Generator, stimulus: Stimulus) -> Stimulus:
    """Add a grey or black object with an albedo of 0.05 to 0.4."""
    return replace(
        ordinary(generator, stimulus), surface=Surface(float(generator.uniform(0.05, 0.4)))
    )


@hides
def posts(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object on a post, with another post above it."""
    depth_m = draw_object(generator, box)
    for _ in range(2):
        depth_m = np.where(np.isnan(depth_m), shapes.post(depth_m, generator), depth_m)[::-1]
    return np.ascontiguousarray(depth_m)


@hides
def tilted(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object tilted by 40 to 75 degrees, up or down and to a side."""
    tilts = np.radians(generator.uniform(40, 75, 2)) * generator.choice([-1, 1], 2)
    pose = {"tilt_x_rad": float(tilts[0]), "tilt_y_rad": float(tilts[1])}
    return draw_object(generator, box, **pose)


def _depth_in(box: ObjectBox, share: float, generator: Generator) -> float:
    """Return a depth between the box's front and a share of its far side's depth, which in a thin
    box may lie before the front.
    """
    return float(generator.uniform(box.z_near_m, max(share * box.z_far_m, box.z_near_m)))


@hides
def plates(generator: Generator, box: ObjectBox) -> Float32:
    """Add a large slanted plate without relief."""
    steps = np.linspace(-0.5, 0.5, OBJECT_PIXELS)
    x, y = np.meshgrid(steps, -steps)
    slope_x, slope_y = generator.uniform(-1, 1, 2)
    depth_m = _depth_in(box, 0.8, generator) + shapes.box_width_m(box) * (slope_x * x + slope_y * y)
    half_x, half_y = generator.uniform(0.3, 0.5, 2)
    covered = (abs(x) < half_x) & (abs(y) < half_y) & (depth_m > 0.5 * box.z_near_m)
    return np.where(covered, depth_m, np.nan).astype(np.float32)


def other_rig(generator: Generator, stimulus: Stimulus) -> Stimulus:
    """Add an ordinary object, and move the lidar by 15 to 50 mm and 2 to 8 degrees."""
    signs = generator.choice([-1, 1], 3)
    place_m, yaw, pitch = signs * generator.uniform([0.015, 2, 2], [0.05, 8, 8])
    return replace(ordinary(generator, stimulus), rig=move_lidar(stimulus.rig, place_m, yaw, pitch))


def other_sensor(generator: Generator, stimulus: Stimulus) -> Stimulus:
    """Add an ordinary object, and multiply the gain by 0.3 to 0.65 or 1.6 to 3."""
    gain = float(generator.choice([generator.uniform(0.3, 0.65), generator.uniform(1.6, 3.0)]))
    sensor = stimulus.sensor.model_copy(
        update={"bare_wall_counts": stimulus.sensor.bare_wall_counts * gain}
    )
    return replace(ordinary(generator, stimulus), sensor=sensor)


@hides
def warped(generator: Generator, box: ObjectBox) -> Float32:
    """Add a warped object: every pixel is displaced by up to a sixth of the box, smoothly."""
    whole_m = draw_object(generator, box)
    steps = np.arange(OBJECT_PIXELS, dtype=np.float32)
    x, y = np.meshgrid(steps, steps)
    off = [
        (smooth_pattern(generator, 5) - np.float32(0.5)) * np.float32(OBJECT_PIXELS / 3)
        for _ in range(2)
    ]
    bent = cv2.remap(whole_m, x + off[0], y + off[1], cv2.INTER_NEAREST, borderValue=float("nan"))
    return bent.astype(np.float32)


@hides
def inside_out(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object turned inside out: near parts become far ones, and relief doubles."""
    whole_m = draw_object(generator, box)
    depth_m = np.nanmin(whole_m) + 2 * (np.nanmax(whole_m) - whole_m)
    return np.minimum(depth_m, np.float32(1.5 * box.z_far_m))


@hides
def cut_out(generator: Generator, box: ObjectBox) -> Float32:
    """Add the flat silhouette of an object, with holes."""
    whole_m = draw_object(generator, box)
    holes = smooth_pattern(generator, int(generator.integers(4, 10))) > generator.uniform(
        0.45, 0.75
    )
    flat = np.where(holes | np.isnan(whole_m), np.nan, np.nanmedian(whole_m))
    return flat.astype(np.float32)


@hides
def scrambled(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object cut into 3 x 3 or 4 x 4 tiles, shuffled."""
    whole_m = draw_object(generator, box)
    n = int(generator.choice([3, 4]))
    side = OBJECT_PIXELS // n
    tiles = [
        whole_m[i * side : (i + 1) * side, j * side : (j + 1) * side]
        for i in range(n)
        for j in range(n)
    ]
    order = generator.permutation(n * n)
    mixed_m = np.block([[tiles[order[i * n + j]] for j in range(n)] for i in range(n)])
    margin = OBJECT_PIXELS - n * side
    return np.pad(mixed_m, (0, margin), constant_values=np.nan).astype(np.float32)


GLOSSY_LOBES = phong(0.1, 0.9, 80.0), retroreflective(0.1, 0.9, 80.0)
"""Shared, since each is compiled."""
MIN_PIXELS = 12
"""Fewest pixels of an outlier."""


@hides
def panels(generator: Generator, box: ObjectBox) -> Float32:
    """Add an object in front of a panel that fills most of the box."""
    depth_m = draw_object(generator, box)
    return np.where(np.isnan(depth_m), shapes.panel(depth_m, box, generator), depth_m)


@hides
def noise_sheet(generator: Generator, box: ObjectBox) -> Float32:
    """Add a sheet of random depth in every pixel."""
    depth_m = generator.uniform(box.z_near_m, box.z_far_m, (OBJECT_PIXELS, OBJECT_PIXELS))
    depth_m[generator.random(depth_m.shape) < generator.uniform(0, 0.5)] = np.nan
    return depth_m.astype(np.float32)


@hides
def bars(generator: Generator, box: ObjectBox) -> Float32:
    """Add a cage of parallel bars, upright or lying."""
    period = int(generator.integers(10, 24))
    at = (np.arange(OBJECT_PIXELS) + int(generator.integers(period))) % period < max(2, period // 4)
    depth_m = np.where(at, _depth_in(box, 0.7, generator), np.nan).astype(np.float32)
    sheet = np.ascontiguousarray(np.broadcast_to(depth_m, (OBJECT_PIXELS, OBJECT_PIXELS)))
    return sheet if generator.random() < 0.5 else np.ascontiguousarray(sheet.T)


@hides
def rings(generator: Generator, box: ObjectBox) -> Float32:
    """Add a torus in any orientation."""
    ring = trimesh.creation.torus(
        1.0, generator.uniform(0.15, 0.35), major_sections=32, minor_sections=16
    )
    turn = euler_matrix(*np.radians(generator.uniform(-60, 60, 3)))[:3, :3]
    pose = shapes.Pose(
        size_m=shapes.box_width_m(box) * generator.uniform(0.55, 0.9),
        front_m=min(generator.uniform(0, 0.1), 0.5 * (box.z_far_m - box.z_near_m)),
    )
    return shapes.orthographic_depth(
        shapes.place(np.asarray(ring.triangles) @ turn.T, pose, box), box
    )


def glossy(generator: Generator, stimulus: Stimulus) -> Stimulus:
    """Add a mirror-like or a retroreflective object."""
    return replace(
        ordinary(generator, stimulus),
        surface=Surface(1.0, GLOSSY_LOBES[int(generator.integers(2))]),
    )


def two_tone(generator: Generator, stimulus: Stimulus) -> Stimulus:
    """Add an object with nearly black patches on about half of it."""
    whole = ordinary(generator, stimulus)
    dark = smooth_pattern(generator, 3) > 0.5
    return replace(whole, surface=Surface(np.where(dark, 0.05, 1.0)))


def _by_name(*kinds: OutlierKind) -> Mapping[str, OutlierKind]:
    return {kind.__name__.replace("_", " "): kind for kind in kinds}


TRAINING_OUTLIERS = _by_name(
    small,
    large,
    far,
    near,
    half_out,
    several,
    blobs,
    dim,
    posts,
    tilted,
    plates,
    other_rig,
    other_sensor,
    warped,
    inside_out,
    cut_out,
    scrambled,
)
HELD_OUT_OUTLIERS = _by_name(panels, noise_sheet, bars, rings, glossy, two_tone)
COVERED_BY_GENERIC = frozenset(
    _by_name(several, blobs, posts, tilted, plates, warped, inside_out, cut_out, scrambled)
)
"""Training outliers that are ordinary to weights that saw generic shapes: several, turned any way,
of any outline.
"""
SHAPE_OUTLIERS = frozenset(
    _by_name(
        blobs,
        posts,
        plates,
        warped,
        inside_out,
        cut_out,
        scrambled,
        panels,
        noise_sheet,
        bars,
        rings,
    )
)
"""Kinds with an unusual shape alone. All others are out of the training range in size, place, tilt,
number, light, rig or sensor."""


def draw_outlier(kind: OutlierKind, generator: Generator, stimulus: Stimulus) -> Stimulus:
    """Return an outlier of a kind, drawn again until it has MIN_PIXELS of surface."""
    while True:
        drawn = kind(generator, stimulus)
        if drawn.depth_m is not None and np.isfinite(drawn.depth_m).sum() >= MIN_PIXELS:
            return drawn


def outliers_beside(share_generic: float) -> Mapping[str, OutlierKind]:
    """Return the training outliers for weights whose training objects had a share of generic
    shapes.
    """
    left_out = COVERED_BY_GENERIC if share_generic else frozenset[str]()
    return {name: kind for name, kind in TRAINING_OUTLIERS.items() if name not in left_out}
