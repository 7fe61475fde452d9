"""Generic shapes for training, beside the 18 categories: they teach surfaces rather than kinds of
objects.

A family draws triangles (n, 3, 3) in units of its own size. Carved shapes and pairs are composed as
depth maps.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import box_width_m, category_triangles, place, random_pose
from nlos_cam.objects.primitives import (
    at,
    bar,
    box,
    disc,
    ellipsoid,
    frame,
    joined,
    lathe,
    pierced,
    prism,
    ring,
)

Generator = np.random.Generator
Family = Callable[[Generator], Float64]
MIN_PIXELS = 40
"""Fewest surface pixels of a shape; it is drawn again below."""


def _turn(generator: Generator) -> Float64:
    """Return a rotation (3, 3), uniform over all of them: a normalised Gaussian quaternion."""
    from trimesh.transformations import quaternion_matrix

    return np.asarray(quaternion_matrix(generator.standard_normal(4)))[:3, :3]


def _solid(generator: Generator) -> Float64:
    """Return a box, an ellipsoid, a frustum (from cylinder to cone) or a torus in any
    orientation.
    """
    # Four kinds of faces: flat, round, conical, and with a hole.
    a, b, c = generator.uniform(0.12, 0.5, 3).tolist()
    kind = int(generator.integers(4))
    if kind == 0:
        solid = box(2 * a, 2 * b, 2 * c)
    elif kind == 1:
        solid = ellipsoid(a, b, c)
    elif kind == 2:
        solid = lathe(
            [
                (0, -b),
                (a, -b),
                (a * generator.random(), b),
                (0, b),
            ]
        )
    else:
        solid = ring(a, a * generator.uniform(0.2, 0.5))
    return solid @ _turn(generator).T


def solids(generator: Generator) -> Float64:
    """Build a union of one to four overlapping solids."""
    count = int(generator.integers(1, 5))
    return joined(
        *(
            at(
                _solid(generator),
                *generator.uniform(-0.4, 0.4, 3),
            )
            for _ in range(count)
        )
    )


def _outline(generator: Generator) -> Float64:
    """Return a star-shaped polygon (n, 2) about the origin: with straight edges, or smooth."""
    if generator.random() < 0.5:
        angle = np.sort(
            generator.uniform(
                0,
                2 * np.pi,
                int(generator.integers(4, 13)),
            )
        )
        radius = generator.uniform(0.15, 0.5, angle.size)
    else:
        angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        # A Fourier series whose amplitudes fall with 1 / order is smooth; its exponential is
        # positive.
        order = np.arange(1, 7)[:, None]
        waves = (
            generator.standard_normal((6, 1))
            / order
            * np.cos(order * angle + generator.uniform(0, 6.3, (6, 1)))
        )
        radius = 0.4 * np.exp(0.6 * waves.sum(0))
    return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def extrusions(generator: Generator) -> Float64:
    """Build a prism over a random polygon, or a pyramid, tilted a little or any way."""
    shape = prism(
        _outline(generator), generator.uniform(0.03, 0.8), generator.choice([0.0, 0.6, 1.0, 1.0])
    )
    return shape @ _turn(generator).T if generator.random() < 0.5 else shape


def strokes(generator: Generator) -> Float64:
    """Build one or two bent bars, as in a written sign."""
    width = generator.uniform(0.06, 0.22)
    thickness = generator.uniform(0.04, 0.3)
    parts = list[Float64]()
    for _ in range(int(generator.integers(1, 3))):
        heading = generator.uniform(0, 2 * np.pi)
        point = generator.uniform(-0.4, 0.4, 2)
        bend = generator.normal(0, 0.4)
        path = [point]
        for _ in range(int(generator.integers(2, 9))):
            heading += generator.choice([bend, generator.normal(0, 1.2)])
            step = generator.uniform(0.12, 0.5) * np.array(
                [
                    np.cos(heading),
                    np.sin(heading),
                ]
            )
            path.append(np.clip(path[-1] + step, -0.7, 0.7) + 1e-6 * step)
        points = [(float(x), float(y)) for x, y in path]
        parts += [bar(a, b, width, thickness) for a, b in pairwise(points)]
        parts += [at(disc(width / 2, thickness), *one) for one in points]
    return joined(*parts)


def profiles(generator: Generator) -> Float64:
    """Build a surface of revolution in any orientation, solid or hollow, often standing or
    tipped.
    """
    # Points from bottom to top; the profile closes on the axis, or along an inner side.
    count = int(generator.integers(3, 9))
    height = np.sort(generator.uniform(-0.5, 0.5, count))
    radius = generator.uniform(0.1, 0.5, count)
    if generator.random() < 0.5:
        radius = np.convolve(np.pad(radius, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    outer = [
        (0.0, float(height[0])),
        *zip(radius.tolist(), height.tolist(), strict=True),
    ]
    inner = [
        (
            max(r - 0.06, 0.02),
            max(h, height[0] + 0.06),
        )
        for r, h in outer[:0:-1]
    ]
    closed = (
        [*inner, (0.0, height[0] + 0.06)]
        if generator.random() < 0.5
        else [(0.0, float(height[-1]))]
    )
    return lathe([*outer, *closed]) @ (
        _turn(generator).T if generator.random() < 0.5 else _tip(generator)
    )


def _tip(generator: Generator) -> Float64:
    """Return a rotation (3, 3), for row vectors, about x by up to 50 degrees either way."""
    angle = np.radians(generator.uniform(-50, 50))
    cos = np.cos(angle)
    sin = np.sin(angle)
    return np.array(
        [
            [1, 0, 0],
            [0, cos, -sin],
            [0, sin, cos],
        ]
    )


def blobs(generator: Generator) -> Float64:
    """Build a smooth closed surface: a sphere whose radius follows random waves."""
    sphere = ellipsoid(0.5, 0.5, 0.5)
    waves = generator.normal(0, generator.uniform(2, 9), (6, 3))
    # Plane waves of random direction and length over the sphere, in the logarithm of the radius.
    grows = np.sin(sphere @ waves.T + generator.uniform(0, 2 * np.pi, 6)) @ generator.uniform(
        0.05, 0.35, 6
    )
    return sphere * np.exp(grows)[..., None] * generator.uniform(0.5, 1.0, 3)


def plates(generator: Generator) -> Float64:
    """Build one to three thin plates, whole, pierced or open like a frame, tilted up to 60
    degrees.
    """
    from trimesh.transformations import rotation_matrix

    parts = list[Float64]()
    for _ in range(int(generator.integers(1, 4))):
        width, height = generator.uniform(0.25, 1.0, 2).tolist()
        border = generator.uniform(0.08, 0.3) * min(width, height)
        kinds = (
            box(width, height, 0.03),
            pierced(width, height, border, 0.03),
            frame(width, height, border, 0.03),
        )
        axis = np.array([*generator.standard_normal(2), 0.0])
        lean = np.asarray(rotation_matrix(generator.uniform(0, 1.05), axis))[:3, :3]
        parts.append(
            at(
                kinds[int(generator.integers(3))] @ lean.T,
                *generator.uniform(-0.4, 0.4, 3),
            )
        )
    return joined(*parts)


def rods(generator: Generator) -> Float64:
    """Build a chain of two to seven thin rods; some branch off."""
    width = generator.uniform(0.05, 0.13)
    ends = list[Float64]([np.zeros(3)])
    parts = list[Float64]()
    for _ in range(int(generator.integers(2, 8))):
        length = generator.uniform(0.3, 1.0)
        turn = _turn(generator)
        start = ends[-1] if generator.random() < 0.6 else ends[int(generator.integers(len(ends)))]
        parts.append(at(box(length, width, width), x=length / 2) @ turn.T + start)
        ends.append(start + turn @ (length, 0, 0))
    return joined(*parts)


def tumbled(generator: Generator) -> Float64:
    """Build an object of one of the 18 categories in any orientation."""
    kind = str(generator.choice(list(CATEGORIES)))
    return category_triangles(kind, int(generator.integers(2**31))) @ _turn(generator).T


FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (solids, extrusions, strokes, profiles, blobs, plates, rods, tumbled)
}
CARVED = 0.2
PAIRS = 0.12
"""Shares of the shapes that are carved by up to three solids, and that are two shapes side by
side.
"""


def generic_depth(seed: int, box: ObjectBox) -> tuple[str, Float32]:
    """Return one generic shape, by the seed alone: its family and its depth map (64, 64) in metres,
    NaN background.
    """
    # The 1 keeps these streams apart from those of `object_depth`.
    generator = np.random.default_rng([seed, OBJECT_PIXELS, 1])
    while True:
        names = generator.choice(list(FAMILIES), 2)
        way = generator.random()
        if way < PAIRS:
            name = f"{names[0]} and {names[1]}"
            depth_m = _pair(generator, box, *map(str, names))
        else:
            triangles = place(FAMILIES[names[0]](generator), random_pose(generator, box), box)
            carved = way < PAIRS + CARVED
            name = f"carved {names[0]}" if carved else str(names[0])
            depth_m = (
                _carve(generator, triangles, box) if carved else orthographic_depth(triangles, box)
            )
        if np.isfinite(depth_m).sum() >= MIN_PIXELS:
            return name, depth_m


def _pair(generator: Generator, box: ObjectBox, *names: str) -> Float32:
    """Return two shapes of 30 to 50 % of the box on opposite sides of its middle, in the same or
    another depth.
    """
    width_m = box_width_m(box)
    angle = generator.uniform(0, 2 * np.pi)
    depths_m = list[Float32]()
    for name, side in zip(names, (1, -1), strict=True):
        offset_m = side * 0.24 * width_m * np.array([np.cos(angle), np.sin(angle)])
        size_m = width_m * generator.uniform(0.3, 0.5)
        pose = replace(
            random_pose(generator, box),
            size_m=size_m,
            x_m=float(offset_m[0]),
            y_m=float(offset_m[1]),
        )
        depths_m.append(orthographic_depth(place(FAMILIES[name](generator), pose, box), box))
    return np.fmin(*depths_m)


def _carve(generator: Generator, triangles: Float64, box: ObjectBox) -> Float32:
    """Return the depth map of a placed body less up to three solids: where one covers the front,
    its back shows.
    """
    # Per cell the body is an interval of depth. A cutter that covers its front leaves the part
    # behind the cutter, or nothing.
    front_m, back_m = _interval(triangles, box)
    points = triangles.reshape(-1, 3)
    size_m = np.ptp(triangles.reshape(-1, 3)[:, :2], axis=0).max()
    for _ in range(int(generator.integers(1, 4))):
        cutter = (
            _solid(generator) * size_m * generator.uniform(0.3, 0.9)
            + points[int(generator.integers(len(points)))]
        )
        from_m, to_m = _interval(cutter, box)
        cut = (from_m <= front_m) & (front_m < to_m)  # false where either is NaN
        front_m = np.where(
            cut,
            np.where(to_m < back_m, to_m, np.nan),
            front_m,
        ).astype(np.float32)
    return front_m


def _interval(triangles: Float64, box: ObjectBox) -> tuple[Float32, Float32]:
    """Return the nearest and farthest depth (64, 64) of a solid; it counts as filled in between."""
    return orthographic_depth(triangles, box), -orthographic_depth(triangles * (1, 1, -1), box)
