"""Files of hidden objects: triangle meshes (.obj, .stl, .ply), folders of meshes, and depth maps
(.npy).

Mesh files are simplified before trimesh parses them, so that none of its optional packages is
needed.
"""

from __future__ import annotations

import hashlib
import logging
import re
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.errors import SceneError, SceneFileError
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.placement import place, random_pose
from nlos_cam.objects.polygons import cut_obj_polygons, ply_triangles

if TYPE_CHECKING:
    import trimesh

_PLAIN = bytes(range(128)).replace(b"\t", b" ") + b"?" * 128
"""Translation of bytes: tab to blank, non-ASCII (only in names and comments) to "?"."""
_COMMENT = re.compile(rb"#[^\n]*")
_INDENT = re.compile(rb"^ +", re.MULTILINE)
_RELATIVE = re.compile(rb" -(\d+)")
_RELATIVE_FACE = re.compile(rb"^f [^\n]*-", re.MULTILINE)
_DECIMAL_COMMA = re.compile(rb"^vn? [^\n]*\d,\d[^\n]*", re.MULTILINE)
_VERTEX_0 = re.compile(rb"^f[^\n]* 0+(?!\d)", re.MULTILINE)


class _MeshProblemError(ValueError):
    """Problem of a mesh file, in words for its user."""


def plain(content: bytes, suffix: str) -> bytes:
    """Return a simpler .obj, .stl or .ply file with the same triangles.

    Raises ValueError where a parser would misread it: a binary of the wrong length, a face of
    vertex 0.
    """
    if suffix == ".ply":
        # As wireframe, edges would need scipy: rename them in the header.
        header, end, body = content.partition(b"end_header")
        content = header.replace(b"element edge ", b"element wire ") + end + body
    if b"\0" in content:
        return _checked_binary(content, suffix)
    text = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = text.translate(_PLAIN)
    return _plain_obj(text) if suffix == ".obj" else text


def _checked_binary(content: bytes, suffix: str) -> bytes:
    if suffix == ".obj":
        raise _MeshProblemError("it is not text")
    return _whole_stl(content) if suffix == ".stl" else content


def _whole_stl(content: bytes) -> bytes:
    """Return a binary .stl of the length that its count of faces asks for.

    Some programs write a count of 0, or add bytes after the last face: both leave no doubt about
    the faces. Raises ValueError for a file that is shorter than its faces.
    """
    counted = int.from_bytes(content[80:84], "little")
    present = (len(content) - 84) // STL_FACE_BYTES
    if counted == 0:
        return (
            content[:80] + present.to_bytes(4, "little") + content[84:][: STL_FACE_BYTES * present]
        )
    if present < counted:
        needed = 84 + STL_FACE_BYTES * counted
        raise _MeshProblemError(
            f"it has {len(content)} bytes, but its {counted} faces take {needed}"
        )
    return content[: 84 + STL_FACE_BYTES * counted]


def _plain_obj(text: bytes) -> bytes:
    text = _COMMENT.sub(b"", text.replace(b"\\\n", b" "))
    text = _INDENT.sub(b"", text)  # trimesh passes over indented lines
    if _RELATIVE_FACE.search(text):
        text = _with_absolute_indices(text)
    if _VERTEX_0.search(text):
        raise _MeshProblemError("a face names vertex 0, but vertices count from 1")
    if comma := _DECIMAL_COMMA.search(text):
        shown = comma[0].decode().strip()
        raise _MeshProblemError(f"it writes numbers with a comma ({shown!r}): use a point")
    return cut_obj_polygons(text)


def _with_absolute_indices(text: bytes) -> bytes:
    """Return a .obj text with absolute vertex numbers in place of relative ones (-1 is the latest
    vertex).
    """
    vertices = 0
    lines = text.split(b"\n")
    for k, line in enumerate(lines):
        if line.startswith(b"v "):
            vertices += 1
        elif line.startswith(b"f "):
            lines[k] = _RELATIVE.sub(partial(_absolute_index, vertices), line)
    return b"\n".join(lines)


# Before the first vertex: 0, which is refused.
def _absolute_index(vertices: int, relative: re.Match[bytes]) -> bytes:
    return b" %d" % max(vertices + 1 - int(relative[1]), 0)


MESH_SUFFIXES = (".obj", ".stl", ".ply")
DEPTH_MAP_SUFFIX = ".npy"
TRUTH_SUFFIX = ".truth.toml"
"""Suffix of a file with the fields of a scene file's [object]: the object, and its pose in the
rig's object box.
"""
MAX_FACES = 2_000_000
"""Read in 2 s (binary .stl) to 16 s (text .ply) and placed in 4 s, on two busy cores."""
MAX_BYTES = 2**28
"""256 MiB: a text .stl takes 300 bytes per face, and four times as much memory while it is
parsed.
"""
MAX_COORDINATE = 1e30
"""Limit of a vertex's coordinates, in any unit: their squares stay finite."""
_REDUCE = "reduce the mesh, or save it as binary"
STL_FACE_BYTES = 50
MIN_CELLS = 8
MAX_CELLS = 256
MAX_DEPTH_M = 10.0
"""Larger than any bench, smaller than a depth map given in millimetres."""

Up = Literal["y", "z"]


@dataclass(frozen=True)
class MeshFile:
    """Mesh read from a file; later changes of the file do not affect it."""

    path: Path
    sha256: str
    """Of the file's content."""
    triangles: Float64 = field(repr=False, compare=False)
    """(n, 3, 3), in the file's unit and axes; all parts joined."""


def read_mesh(path: Path) -> MeshFile:
    """Return a mesh with all its parts. Raises SceneFileError for a file without a mesh that can be
    placed.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise SceneFileError(
            f"{path} is not a mesh: give a file that ends in {', '.join(MESH_SUFFIXES)}"
        )
    with _readable(path, f"{suffix} file", "export it again, as triangles"):
        if (size := path.stat().st_size) > MAX_BYTES:
            raise SceneFileError(
                f"{path} has {size / 2**20:.0f} MiB, the limit is {MAX_BYTES >> 20} MiB: {_REDUCE}"
            )
        content = path.read_bytes()
        triangles = _triangles_of(content, suffix)
    if problem := _problem(triangles):
        raise SceneFileError(f"{path} {problem}")
    return MeshFile(path, hashlib.sha256(content).hexdigest(), triangles)


def turn_upright(triangles: Float64, up: Up) -> Float64:
    """Return triangles (n, 3, 3) turned so that the axis `up` of their file becomes y.

    With z up, as in CAD and Blender, the file's +y turns towards the wall (-z), as in an export
    with y up.
    """
    return triangles if up == "y" else triangles[..., [0, 2, 1]] * (1, 1, -1)


def read_depth_map(path: Path) -> Float32:
    """Return a depth map (n, n) in metres over the object box, NaN for background, from numbers of
    any real type.

    Raises SceneFileError where the file holds anything else.
    """
    # No pickles; a huge shape in the header costs nothing.
    with _readable(path, "depth map", "save one with numpy.save(file, depth_m)"):
        stored = np.lib.format.open_memmap(path, mode="r")
    if stored.dtype.kind not in "fiu":
        raise SceneFileError(
            f"{path} holds {stored.dtype} values: a depth map holds real numbers, in metres"
        )
    if (
        stored.ndim != 2
        or stored.shape[0] != stored.shape[1]
        or not MIN_CELLS <= len(stored) <= MAX_CELLS
    ):
        size = f"(n, n) with n from {MIN_CELLS} to {MAX_CELLS}"
        raise SceneFileError(f"{path} has shape {stored.shape}: a depth map has shape {size}")
    surface = stored[~np.isnan(stored)]
    if surface.size and not (surface.min() >= 0 and surface.max() <= MAX_DEPTH_M):
        worst = surface.min() if surface.min() < 0 else surface.max()
        raise SceneFileError(
            f"{path} has a depth of {worst:g} m: depths are in metres from the wall into the room, "
            f"0 to {MAX_DEPTH_M:g} (negative is behind the wall), NaN for background"
        )
    return np.array(stored, np.float32)


def _check_openable(path: Path, kind: str) -> None:
    """Raise SceneFileError for a pipe or a device: opening one would wait for a writer."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise SceneFileError(f"{path} is not a file: give the path of a {kind}")


@contextmanager
def _readable(path: Path, kind: str, advice: str) -> Generator[None]:
    """Raise any error of a parser on a missing or damaged file as one SceneFileError."""
    try:
        _check_openable(path, kind)
        yield
    except SceneError:
        raise
    except OSError as error:
        raise SceneFileError(
            f"{path} cannot be read as a {kind}: {error.strerror or error}"
        ) from error
    except Exception as error:
        # A parser's own words would not help.
        problem = f" ({error})" if isinstance(error, _MeshProblemError) else ""
        raise SceneFileError(f"{path} is damaged or not a {kind}{problem}: {advice}") from error


@contextmanager
def _strict() -> Generator[None]:
    """Turn warnings of unreadable numbers into errors, and silence the log of trimesh."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            yield
    finally:
        log.setLevel(level)


def _parts(content: bytes, suffix: str) -> list[trimesh.Trimesh]:
    """Return every mesh in a file, unprocessed. From a stream, trimesh cannot search for materials
    and textures.
    """
    import trimesh

    with _strict():
        stream = BytesIO(plain(content, suffix))
        scene = trimesh.load_scene(stream, suffix[1:], process=False, fix_texture=False)
    return [part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh)]


def _triangles_of(content: bytes, suffix: str) -> Float64:
    """Return the triangles (n, 3, 3) of a file's content."""
    if suffix == ".ply" and _has_strips(content):
        return _ply_polygons(content)
    parts = _parts(content, suffix)
    triangles = np.concatenate([np.empty((0, 3, 3)), *(_triangles(part) for part in parts)])
    # More triangles than faces: the parser cut polygons as fans. Fewer: some faces have no three
    # corners, or a text file is cut short, of which the parser takes what is left.
    if suffix == ".ply" and len(triangles) != _ply_face_count(content):
        return _ply_polygons(content)
    return triangles


def _ply_polygons(content: bytes) -> Float64:
    with _strict():  # plyfile warns of a face without corners
        return ply_triangles(content)


def _has_strips(content: bytes) -> bool:
    return b"element tristrips" in content.partition(b"end_header")[0]


def _ply_face_count(content: bytes) -> int:
    found = re.search(rb"element face (\d+)", content.partition(b"end_header")[0])
    return int(found[1]) if found else 0


def _triangles(part: trimesh.Trimesh) -> Float64:
    faces = np.asarray(part.faces, np.int64).reshape(-1, 3)
    if faces.size and faces.min() < 0:
        raise _MeshProblemError(f"a face names vertex {faces.min()}")
    return np.asarray(part.vertices, np.float64)[faces]


def _problem(triangles: Float64) -> str:
    """Return the reason why triangles (n, 3, 3) cannot be placed; empty where they can."""
    if not len(triangles):
        return "has no faces: it is empty, cut short or a point cloud; export a mesh of triangles"
    if len(triangles) > MAX_FACES:
        return f"has {len(triangles)} faces, the limit is {MAX_FACES}: {_REDUCE}"
    if not np.abs(triangles).max() <= MAX_COORDINATE:  # false for NaN too
        return (
            f"has a vertex that is NaN, infinite or beyond {MAX_COORDINATE:g}: repair or export it"
            " again"
        )
    extent = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    normals = np.cross(
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    if not np.abs(normals).max() > 1e-12 * extent**2:
        return "has no face with an area: it is a point or a line; export a surface or a solid"
    return ""


POSES = 20
"""Poses to try before a mesh counts as invisible: a sheet may be edge on in one of them."""
Mesh = TypeVar("Mesh")


def folder_objects(folder: Path) -> list[Path]:
    """Return the meshes (.obj, .stl, .ply) of a folder and its subfolders, sorted by relative path.

    Files and folders that start with a dot are skipped. Raises SceneError where there is no such
    folder, or no mesh.
    """
    if not folder.is_dir():
        raise SceneError(
            f"no folder {folder}: give one that holds meshes ({', '.join(MESH_SUFFIXES)})"
        )
    found = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in MESH_SUFFIXES and path.is_file()
    ]
    meshes = {path.relative_to(folder).parts: path for path in found}
    visible = [
        meshes[parts] for parts in sorted(meshes) if not any(part.startswith(".") for part in parts)
    ]
    if not visible:
        raise SceneError(
            f"no meshes in {folder} and its subfolders: add files that end in"
            f" {', '.join(MESH_SUFFIXES)}"
        )
    return visible


def mesh_depth(
    seed: int,
    meshes: Sequence[Mesh],
    box: ObjectBox,
    up: Up = "y",
    *,
    read: Callable[[Mesh], MeshFile],
) -> tuple[Mesh, Float32]:
    """Return one of the meshes and its depth map (64, 64) in metres, NaN background; the seed picks
    mesh and pose.

    Poses are those of procedural objects, up to POSES of them until one shows a surface. Only the
    picked mesh is read. Raises SceneError, with the file's name, where none does.
    """
    generator = np.random.default_rng([seed, OBJECT_PIXELS])
    picked = meshes[int(generator.integers(len(meshes)))]
    return picked, _posed_depth(read(picked), box, up, generator)


def check_visible(mesh: MeshFile, box: ObjectBox, up: Up = "y") -> None:
    """Raise SceneError for a mesh that shows no surface in any of POSES poses in a box."""
    _posed_depth(mesh, box, up, np.random.default_rng(0))


def _posed_depth(mesh: MeshFile, box: ObjectBox, up: Up, generator: np.random.Generator) -> Float32:
    """Return the depth map of a mesh in the first of POSES random poses that shows a surface.
    Raises SceneError where none does.
    """
    triangles = turn_upright(mesh.triangles, up)
    for _ in range(POSES):
        depth_m = orthographic_depth(place(triangles, random_pose(generator, box), box), box)
        if not np.isnan(depth_m).all():
            return depth_m
    raise SceneError(
        f"{mesh.path} shows no surface in any of {POSES} poses (thinner than a depth-map cell):"
        " make it thicker, or remove it from the folder"
    )
