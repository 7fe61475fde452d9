"""The few solids that objects are made of, as trimesh meshes; y is up, the wall looks along +z."""

from collections.abc import Sequence
from typing import cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh import transformations

SECTIONS = 28

Mesh = trimesh.Trimesh
Vector = Sequence[float]


def at(mesh: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    """The mesh moved by (x, y, z)."""
    return mesh.apply_translation([x, y, z])


def turned(mesh: Mesh, axis: Vector, angle_deg: float) -> Mesh:
    """The mesh turned about an axis through the origin."""
    return mesh.apply_transform(transformations.rotation_matrix(np.radians(angle_deg), axis))


def joined(*parts: Mesh) -> Mesh:
    """One mesh of several; inner faces stay, since only the front is ever seen."""
    return cast("Mesh", trimesh.util.concatenate(parts))


def box(width: float, height: float, depth: float) -> Mesh:
    """A box centred on the origin."""
    return trimesh.creation.box(extents=(width, height, depth))


def ellipsoid(rx: float, ry: float, rz: float) -> Mesh:
    """An ellipsoid centred on the origin."""
    return trimesh.creation.icosphere(subdivisions=3).apply_scale((rx, ry, rz))


def ring(radius: float, tube: float) -> Mesh:
    """A torus in the x-y plane."""
    return trimesh.creation.torus(radius, tube, major_sections=SECTIONS, minor_sections=12)


def lathe(profile: Sequence[tuple[float, float]]) -> Mesh:
    """The solid that a profile of (radius, height) sweeps about the y axis."""
    mesh = trimesh.creation.revolve(np.asarray(profile, float), sections=SECTIONS)
    return turned(mesh, (1, 0, 0), -90)


def slab(corners: Sequence[tuple[float, float]], thickness: float) -> Mesh:
    """A convex polygon of (x, y) corners in the x-y plane, given a thickness along z."""
    outline: NDArray[np.float64] = np.asarray(corners, float)
    n = len(outline)
    front = np.column_stack([outline, np.full(n, -thickness / 2)])
    back = np.column_stack([outline, np.full(n, thickness / 2)])
    fan = [(0, k, k + 1) for k in range(1, n - 1)]
    sides = [(k, (k + 1) % n, n + k) for k in range(n)] + [(n + k, (k + 1) % n, n + (k + 1) % n) for k in range(n)]
    faces = fan + [(n + a, n + b, n + c) for a, b, c in fan] + sides
    return Mesh(np.vstack([front, back]), faces, process=False)
