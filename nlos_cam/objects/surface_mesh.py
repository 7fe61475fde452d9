"""Triangle mesh of a hidden surface: made from its depth map, written for other programs."""

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64, Int64

from nlos_cam.errors import NlosCamError
from nlos_cam.files import atomic_file
from nlos_cam.objects.depth_map import cell_centers_m

JUMP_M = 0.02
"""Depth difference above which neighbouring cells are separate surfaces: neither a triangle of a
mesh nor a curtain of the renderer's patches (beta, S3) may join them.
"""
MAX_UNCERTAINTY_M = 0.03
"""Uncertainty drawn brightest, in meshes, view and plots; the object box is 0.28 m deep."""
NEUTRAL = 180, 180, 180, 255
"""RGBA of the vertices of a mesh without uncertainty."""


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles of a hidden surface in the wall frame, in metres: x along the wall, y up, z into
    the room.
    """

    vertices_m: Float64
    """(n, 3)."""
    faces: Int64
    """(k, 3): rows of `vertices_m`, clockwise seen from the room: the lit side faces the wall. (0,
    3) for points only.
    """
    uncertainty_m: Float32 | None = None
    """(n,): expected absolute error of each vertex's z; None without an uncertainty model."""

    @property
    def points_only(self) -> "SurfaceMesh":
        """The vertices without faces, for `save` to write as a point cloud."""
        return SurfaceMesh(self.vertices_m, self.faces[:0], self.uncertainty_m)

    def save(self, path: Path | str) -> None:
        """Write a file of the kind that its suffix names, replacing one of that name (see
        `as_bytes`).
        """
        path = Path(path)
        try:
            content = self.as_bytes(path.suffix)
        except NlosCamError as error:
            raise NlosCamError(f"{path} was not written: {error}") from error
        with atomic_file(path) as part:
            part.write_bytes(content)

    def as_bytes(self, suffix: str) -> bytes:
        """Return the content of a file of this kind.

        .ply, .glb and .obj hold the mesh, with the uncertainty as color (violet 0, yellow 30 mm)
        and, but for .obj, as a number of each vertex; .csv holds the vertices; .npz the arrays.
        Raises NlosCamError for another suffix, and for a mesh without vertices.
        """
        if suffix not in WRITERS:
            raise NlosCamError(f"no mesh format {suffix!r}: choose {', '.join(WRITERS)}")
        if not len(self.vertices_m):
            raise NlosCamError("there is no surface to save")
        return WRITERS[suffix](self)


def mesh_from_depth(
    depth_m: Float32, box: ObjectBox, uncertainty_m: Float32 | None = None, jump_m: float = JUMP_M
) -> SurfaceMesh:
    """Return the mesh of a hidden depth map (n, n) over the box, with a vertex at the centre of
    each surface cell.

    No triangle spans a step of more than `jump_m`. A cell that is part of no triangle (alone, or of
    a line one cell wide) becomes a square of the cell's size, so that the mesh, sampled at the
    cells' centres, is the depth map.
    """
    x_m, y_m = cell_centers_m(box, len(depth_m))
    points_m = np.stack(
        [*np.meshgrid(x_m, y_m), depth_m],
        axis=-1,
        dtype=np.float64,
    ).reshape(-1, 3)
    faces = _faces(depth_m, jump_m)
    # Vertices: first the cells that triangles use, then four for each cell that none uses.
    alone = np.setdiff1d(np.flatnonzero(np.isfinite(depth_m)), faces)
    used = np.unique(faces)
    half_x_m = 0.5 * (box.x_max_m - box.x_min_m) / len(depth_m)
    half_y_m = 0.5 * (box.y_max_m - box.y_min_m) / len(depth_m)
    # Corners of a lone cell's square, row by row, and its two triangles.
    corners_m = np.array([[-1, 1, 0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    corners_m = corners_m * (half_x_m, half_y_m, 0.0)
    first = len(used) + 4 * np.arange(len(alone))
    squares = first[:, None, None] + np.array([[0, 1, 2], [1, 3, 2]])
    cells = np.concatenate([used, np.repeat(alone, 4)])
    return SurfaceMesh(
        np.concatenate(
            [
                points_m[used],
                (points_m[alone, None] + corners_m).reshape(-1, 3),
            ]
        ),
        np.concatenate(
            [
                np.searchsorted(used, faces),
                squares.reshape(-1, 3),
            ]
        ).astype(np.int64),
        None if uncertainty_m is None else uncertainty_m.reshape(-1)[cells].astype(np.float32),
    )


def _faces(depth_m: Float32, jump_m: float) -> Int64:
    """Return triangles (k, 3) of cells (numbered row by row) between whose corners the depth does
    not jump.
    """
    index = np.arange(depth_m.size).reshape(depth_m.shape)
    z_m = depth_m.reshape(-1)
    a, b, c, d = (
        part.reshape(-1)
        for part in (
            index[:-1, :-1],
            index[:-1, 1:],
            index[1:, :-1],
            index[1:, 1:],
        )
    )
    # Of four neighbours (a b / c d) the diagonal with the smaller step of depth is an edge. One
    # through a background cell counts as an infinite step, so that the triangle of the other three
    # cells remains.
    down, up = (
        np.nan_to_num(
            np.abs(z_m[one] - z_m[other]),
            nan=np.inf,
        )
        for one, other in ((a, d), (b, c))
    )
    # All clockwise seen from the room, so that the lit side faces the wall.
    first = np.where(down < up, [a, b, d], [a, b, c])
    second = np.where(down < up, [a, d, c], [b, d, c])
    faces = np.concatenate([first.T, second.T])
    return faces[np.ptp(z_m[faces], axis=1) <= jump_m]  # false with a background cell


def _with_trimesh(kind: str, attribute: str = "", **options: Any) -> Callable[[SurfaceMesh], bytes]:
    """Return a writer by trimesh; `attribute` names the uncertainty of a vertex in the file."""

    def write(mesh: SurfaceMesh) -> bytes:
        import trimesh

        colors = _colors(mesh)
        if not len(mesh.faces):
            made: Any = trimesh.PointCloud(mesh.vertices_m, colors)
        else:
            made = trimesh.Trimesh(mesh.vertices_m, mesh.faces, vertex_colors=colors, process=False)
            if attribute and mesh.uncertainty_m is not None:
                made.vertex_attributes[attribute] = mesh.uncertainty_m
        content = made.export(file_type=kind, **options)
        return content.encode() if isinstance(content, str) else content

    return write


def _colors(mesh: SurfaceMesh) -> Any:
    if mesh.uncertainty_m is None:
        return np.full((len(mesh.vertices_m), 4), NEUTRAL, np.uint8)
    import cv2

    # An unknown error is drawn like a large one.
    share = np.clip(np.nan_to_num(mesh.uncertainty_m, nan=np.inf) / MAX_UNCERTAINTY_M, 0.0, 1.0)
    bgr = cv2.applyColorMap(
        np.rint(255 * share).astype(np.uint8)[:, None],
        cv2.COLORMAP_VIRIDIS,
    )[:, 0]
    return np.column_stack(
        [
            bgr[:, ::-1],
            np.full(len(bgr), 255, np.uint8),
        ]
    )


def _as_double_sided(tree: dict[str, Any]) -> None:
    """Add a material to a glTF tree that is drawn from both sides: viewers begin in the room,
    behind the surface.
    """
    tree["materials"] = [
        {
            "doubleSided": True,
            "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9},
        }
    ]
    for primitive in (each for mesh in tree["meshes"] for each in mesh["primitives"]):
        primitive["material"] = 0


def _as_csv(mesh: SurfaceMesh) -> bytes:
    errors_m = [""] * len(mesh.vertices_m)
    if mesh.uncertainty_m is not None:
        errors_m = [f"{value:.5f}" for value in mesh.uncertainty_m]
    rows = [
        f"{x:.5f},{y:.5f},{z:.5f},{error_m}"
        for (x, y, z), error_m in zip(mesh.vertices_m, errors_m, strict=True)
    ]
    return "\n".join(["x_m,y_m,z_m,uncertainty_m", *rows, ""]).encode()


def _as_npz(mesh: SurfaceMesh) -> bytes:
    arrays: dict[str, Any] = {"vertices_m": mesh.vertices_m, "faces": mesh.faces}
    if mesh.uncertainty_m is not None:
        arrays["uncertainty_m"] = mesh.uncertainty_m
    memory = BytesIO()
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


WRITERS: dict[str, Callable[[SurfaceMesh], bytes]] = {
    ".ply": _with_trimesh("ply", "uncertainty_m"),
    ".glb": _with_trimesh("glb", "_uncertainty_m", tree_postprocessor=_as_double_sided),
    ".obj": _with_trimesh("obj"),
    ".csv": _as_csv,
    ".npz": _as_npz,
}
