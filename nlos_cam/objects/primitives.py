"""Primitive solids of the object generators, as triangles (n, 3, 3): y is up, the wall lies towards
-z.

trimesh takes longer to import than all else here, and no camera needs it: its users import it when
they run.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

SECTIONS = 28
"""Facets of a full turn."""

Point = tuple[float, float]


def at(triangles: Float64, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float64:
    """Return the solid moved by (x, y, z)."""
    return triangles + np.array([x, y, z])


def turned(triangles: Float64, axis: Sequence[float], angle_deg: float) -> Float64:
    """Return the solid turned about an axis through the origin."""
    from trimesh.transformations import rotation_matrix

    turn = np.asarray(rotation_matrix(np.radians(angle_deg), axis))
    return triangles @ turn[:3, :3].T


def tipped(triangles: Float64, angle_deg: float) -> Float64:
    """Return the solid with its top tipped towards the wall, as if seen from above by that
    angle.
    """
    return turned(triangles, (1, 0, 0), -angle_deg)


def joined(*parts: Float64) -> Float64:
    """Return several solids as one; inner faces stay, since only the front shows."""
    return np.concatenate(parts)


def box(width: float, height: float, depth: float) -> Float64:
    """Return a box centred on the origin."""
    return _unit_box() * (width, height, depth)


def ellipsoid(rx: float, ry: float, rz: float) -> Float64:
    """Return an ellipsoid centred on the origin."""
    return _unit_sphere(3) * (rx, ry, rz)


def knob(radius: float, reach: float) -> Float64:
    """Return an ellipsoid of half-depth `reach` along z, with a quarter of the faces of
    `ellipsoid`.
    """
    return _unit_sphere(2) * (radius, radius, reach)


def lathe(profile: Sequence[Point]) -> Float64:
    """Return the solid that a profile of (radius, height) sweeps about the y axis."""
    # The last section is the first again: the grid closes on itself.
    angle = np.linspace(0, 2 * np.pi, SECTIONS + 1)[:, None]
    radius, height = np.asarray(profile, float).T
    return _grid_surface(
        np.stack(
            np.broadcast_arrays(radius * np.cos(angle), height, radius * np.sin(angle)), axis=-1
        )
    )


def disc(radius: float, thickness: float) -> Float64:
    """Return a disc centred on the origin that faces the wall."""
    half = thickness / 2
    return turned(
        lathe(
            [
                (0, -half),
                (radius, -half),
                (radius, half),
                (0, half),
            ]
        ),
        (1, 0, 0),
        -90,
    )


def ring(radius: float, tube: float) -> Float64:
    """Return a torus in the x-y plane."""
    return arch(radius, tube, 360)


def arch(radius: float, tube: float, angle_deg: float = 180.0) -> Float64:
    """Return part of a torus in the x-y plane, from the +x axis on, counter-clockwise with y up."""
    # Torus: a circle of radius `tube` at the distance `radius` from the axis z.
    along = np.linspace(0, np.radians(angle_deg), SECTIONS + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, 13)
    distance = radius + tube * np.cos(around)
    points = distance * np.cos(along), distance * np.sin(along), tube * np.sin(around)
    return _grid_surface(np.stack(np.broadcast_arrays(*points), axis=-1))


def slab(corners: Sequence[Point], thickness: float) -> Float64:
    """Return a convex polygon of (x, y) corners with a thickness along z."""
    # Front and back are fans of triangles from corner 0, the sides two triangles an edge.
    outline: NDArray[np.float64] = np.asarray(corners, float)
    n = len(outline)
    front = np.column_stack([outline, np.full(n, -thickness / 2)])
    back = np.column_stack([outline, np.full(n, thickness / 2)])
    fan = [(0, k, k + 1) for k in range(1, n - 1)]
    sides = [(k, (k + 1) % n, n + k) for k in range(n)] + [
        (n + k, (k + 1) % n, n + (k + 1) % n) for k in range(n)
    ]
    faces = fan + [(n + a, n + b, n + c) for a, b, c in fan] + sides
    return np.vstack([front, back])[np.asarray(faces)]


def prism(outline: NDArray[np.float64], thickness: float, taper: float = 1.0) -> Float64:
    """Return a star-shaped polygon (n, 2) about the origin with a thickness along z; its front is
    `taper` as wide.
    """
    # Star-shaped: each edge forms a triangle with the middle that lies inside.
    a = outline
    b = np.roll(outline, -1, axis=0)
    middle = np.zeros_like(a)
    half = thickness / 2
    near = [
        np.pad(
            taper * points,
            ((0, 0), (0, 1)),
            constant_values=-half,
        )
        for points in (a, b, middle)
    ]
    far = [
        np.pad(
            points,
            ((0, 0), (0, 1)),
            constant_values=half,
        )
        for points in (a, b, middle)
    ]
    sides = [
        [near[0], near[1], far[1]],
        [near[0], far[1], far[0]],
    ]
    return np.concatenate([np.stack(corners, axis=1) for corners in (near, far, *sides)])


def bar(start: Point, end: Point, width: float, thickness: float) -> Float64:
    """Return a straight bar in the x-y plane from one point to another."""
    # (u, v) is the normal of the bar with half its width as length.
    x0, y0 = start
    x1, y1 = end
    share = width / 2 / np.hypot(x1 - x0, y1 - y0)
    u = (y0 - y1) * share
    v = (x1 - x0) * share
    return slab(
        [
            (x0 - u, y0 - v),
            (x0 + u, y0 + v),
            (x1 + u, y1 + v),
            (x1 - u, y1 - v),
        ],
        thickness,
    )


def pierced(width: float, height: float, hole: float, thickness: float) -> Float64:
    """Return a plate centred on the origin that faces the wall, with a hole of radius `hole` in its
    middle.
    """
    # Rays from the centre hit the plate's rectangle where max(|x| / (width / 2), |y| / (height /
    # 2)) is 1.
    angle = np.linspace(0, 2 * np.pi, SECTIONS + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    edge = circle / np.abs(circle / (width / 2, height / 2)).max(axis=1, keepdims=True)
    corners = np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) * (width / 2, height / 2)
    for corner in corners:  # snap the nearest ray to the corner, which would otherwise be cut off
        edge[np.linalg.norm(edge - corner, axis=1).argmin()] = corner
    loops = [
        (hole * circle, -1),
        (edge, -1),
        (edge, 1),
        (hole * circle, 1),
        (hole * circle, -1),
    ]
    rings = [
        np.column_stack([loop, np.full(len(loop), side * thickness / 2)]) for loop, side in loops
    ]
    return _grid_surface(np.stack(rings, axis=1))


def frame(width: float, height: float, border: float, thickness: float) -> Float64:
    """Return a rectangular frame centred on the origin that faces the wall; its border lies
    inside.
    """
    # Rails over the whole width, posts over the whole height: they overlap in the corners.
    rail = box(width, border, thickness)
    post = box(border, height, thickness)
    up = (height - border) / 2
    aside = (width - border) / 2
    return joined(
        at(rail, y=up),
        at(rail, y=-up),
        at(post, aside),
        at(post, -aside),
    )


@cache
def _unit_box() -> Float64:
    from trimesh import creation

    return np.asarray(creation.box().triangles, np.float64)


@cache
def _unit_sphere(subdivisions: int) -> Float64:
    from trimesh import creation

    return np.asarray(creation.icosphere(subdivisions).triangles, np.float64)


def _grid_surface(points: NDArray[np.float64]) -> Float64:
    """Return the surface through a grid of points (rows, columns, 3): two triangles per grid
    cell.
    """
    # Corners of each cell in turn a, b, c, d; its diagonal is a c.
    a = points[:-1, :-1]
    b = points[1:, :-1]
    c = points[1:, 1:]
    d = points[:-1, 1:]
    halves = [np.stack(corners, axis=2) for corners in ([a, b, c], [a, c, d])]
    return np.concatenate(halves).reshape(-1, 3, 3)
