"""Faces of more than three corners as triangles: concave polygons keep their own area.

Parsers of meshes cut a polygon as a fan from its first corner. That is right for a convex one; of a
star or a ring it covers what lies outside the polygon too. Concave ones are cut by ear clipping
(the library mapbox-earcut) in the plane of the polygon.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

if TYPE_CHECKING:
    import plyfile

Corners = NDArray[np.int64]
FLAT = 1e-9
"""Sine of an angle that counts as straight, so that rounding makes no convex polygon concave."""


def triangulate(points: Float64) -> Corners:
    """Return the corners (m, 3) of triangles that cover a polygon (n, 3), by index.

    A polygon without an area, or with fewer than three corners, gives none.
    """
    no_triangles = np.empty((0, 3), np.int64)
    if len(points) < 3:
        return no_triangles
    normal = newell_normal(points)
    if not np.abs(normal).max() > 0:
        return no_triangles
    if is_convex(points, normal):
        fan = np.arange(1, len(points) - 1)
        return np.stack([np.zeros_like(fan), fan, fan + 1], 1)

    import mapbox_earcut

    # Along its normal's largest part, a polygon's projection keeps its corners in order.
    kept = np.delete(np.arange(3), int(np.abs(normal).argmax()))
    flat = np.ascontiguousarray(points[:, kept])
    ring_ends = np.array([len(points)], np.uint32)
    return mapbox_earcut.triangulate_float64(flat, ring_ends).reshape(-1, 3).astype(np.int64)


def newell_normal(points: Float64) -> Float64:
    """Return the normal (3,) of a polygon (n, 3), twice as long as its area: the sum of the cross
    products of consecutive corners, which also holds for corners that are not quite in a plane.
    """
    following = np.roll(points, -1, axis=0)
    return np.cross(points - points[0], following - points[0]).sum(0)


def is_convex(points: Float64, normal: Float64) -> bool:
    """Return True if no corner of a polygon (n, 3) turns against its normal."""
    edges = np.roll(points, -1, axis=0) - points
    turns = np.cross(edges, np.roll(edges, -1, axis=0)) @ normal
    lengths = np.linalg.norm(edges, axis=1)
    longest = lengths * np.roll(lengths, -1) * np.linalg.norm(normal)
    return bool((turns >= -FLAT * longest).all())


def cut_obj_polygons(text: bytes) -> bytes:
    """Return the text of an .obj with triangles in place of concave polygons.

    Vertex numbers are absolute. Numbers that are not there, or no numbers, stay for the parser to
    refuse.
    """
    lines = text.split(b"\n")
    polygons = [
        at for at, line in enumerate(lines) if line.startswith(b"f ") and line.count(b" ") > 3
    ]
    if not polygons:
        return text

    vertices = _obj_vertices(lines)
    for at in polygons:
        corners = lines[at].split()[1:]
        numbers = [_vertex_index(corner) for corner in corners]
        if len(corners) < 4 or not all(0 <= number < len(vertices) for number in numbers):
            continue
        points = vertices[numbers]
        if not np.isfinite(points).all() or is_convex(points, newell_normal(points)):
            continue
        cut = triangulate(points)
        lines[at] = b"\n".join(b"f " + b" ".join(corners[k] for k in face) for face in cut)
    return b"\n".join(lines)


def _obj_vertices(lines: Sequence[bytes]) -> Float64:
    """Return the vertices (n, 3) of an .obj, NaN for those that are no numbers."""
    rows = [line.split()[1:4] for line in lines if line.startswith(b"v ")]
    vertices = np.full((len(rows), 3), np.nan)
    for k, row in enumerate(rows):
        try:
            vertices[k] = [float(number) for number in row]
        except ValueError:
            continue
    return vertices


def _vertex_index(corner: bytes) -> int:
    """Return the index, from 0, of a corner "vertex/texture/normal"; -1 for none."""
    number = corner.split(b"/")[0]
    return int(number) - 1 if number.isdigit() else -1


def ply_triangles(content: bytes) -> Float64:
    """Return the triangles (n, 3, 3) of a .ply whose faces are polygons or triangle strips.

    Raises ValueError where a face names a vertex that is not there.
    """
    import plyfile

    found = plyfile.PlyData.read(BytesIO(content))
    vertices = np.stack([found["vertex"][axis] for axis in "xyz"], 1).astype(np.float64)
    faces = [_checked(face, len(vertices)) for face in _ply_faces(found)]
    triangles = [vertices[face[triangulate(vertices[face])]] for face in faces]
    return np.concatenate([np.empty((0, 3, 3)), *triangles])


def _ply_faces(found: plyfile.PlyData) -> Iterator[Corners]:
    names = {element.name for element in found.elements}
    for name in {"face", "tristrips"} & names:
        element = found[name]
        lists = [entry.name for entry in element.properties if hasattr(entry, "len_dtype")]
        wanted = [entry for entry in lists if entry in {"vertex_indices", "vertex_index"}]
        if not wanted:
            continue
        for row in element[wanted[0]]:
            corners = np.asarray(row, np.int64)
            yield from [corners] if name == "face" else _strip_faces(corners)


def _strip_faces(strips: Corners) -> Iterator[Corners]:
    """Yield the triangles of strips that are separated by -1."""
    for strip in np.split(strips, np.flatnonzero(strips < 0)):
        numbers = strip[strip >= 0]
        for k in range(len(numbers) - 2):
            yield numbers[k : k + 3]


def _checked(face: Corners, vertices: int) -> Corners:
    if face.size and not 0 <= face.min() <= face.max() < vertices:
        raise ValueError(f"a face names vertex {face.max()} of {vertices}")
    return face
