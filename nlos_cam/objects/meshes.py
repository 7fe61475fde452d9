"""Hidden objects from files: triangle meshes (.obj, .stl, .ply) and depth maps (.npy).

Mesh files made plain enough for a parser that has none of its optional packages.

Hidden objects from a folder of meshes: which files it holds, and one of them at a random pose for each seed.
"""

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
from typing import Literal, TypeVar

import numpy as np
import trimesh
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.placement import place, random_pose

_PLAIN = bytes(range(128)).replace(b"\t", b" ") + b"?" * 128
"""Tabs as blanks; letters of other alphabets, which only names and comments hold, as "?"."""
_COMMENT = re.compile(rb"#[^\n]*")
_RELATIVE = re.compile(rb" -(\d+)")
_RELATIVE_FACE = re.compile(rb"^f [^\n]*-", re.MULTILINE)
_VERTEX_0 = re.compile(rb"^f[^\n]* 0+(?!\d)", re.MULTILINE)


def plain(content: bytes, suffix: str) -> bytes:
    """The content of a .obj, .stl or .ply file with the same triangles.

    Raises ValueError where a parser would go astray: binary of the wrong length, a face of vertex 0.
    """
    if suffix == ".ply":
        content = _without_edges(content)
    if b"\0" in content:
        return _checked_binary(content, suffix)
    text = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").translate(_PLAIN)
    return _plain_obj(text) if suffix == ".obj" else text


def _checked_binary(content: bytes, suffix: str) -> bytes:
    if suffix == ".obj":
        raise ValueError("it is not text")
    faces = int.from_bytes(content[80:84], "little")
    if suffix == ".stl" and len(content) != 84 + 50 * faces:
        raise ValueError(f"it has {len(content)} bytes, but its {faces} faces take {84 + 50 * faces}")
    return content


def _without_edges(content: bytes) -> bytes:
    """A .ply file whose edges go by another name: as wireframe they would ask for scipy."""
    header, end, body = content.partition(b"end_header")
    return header.replace(b"element edge ", b"element wire ") + end + body


def _plain_obj(text: bytes) -> bytes:
    text = _COMMENT.sub(b"", text.replace(b"\\\n", b" "))
    if _RELATIVE_FACE.search(text):
        text = _absolute(text)
    if _VERTEX_0.search(text):
        raise ValueError("a face names vertex 0, but vertices count from 1")
    return text


def _absolute(text: bytes) -> bytes:
    """A .obj text whose faces name no vertex by how far back it stands (-1 is the latest)."""
    seen, lines = 0, text.split(b"\n")
    for k, line in enumerate(lines):
        if line.startswith(b"v "):
            seen += 1
        elif line.startswith(b"f "):
            lines[k] = _RELATIVE.sub(partial(_number, seen), line)
    return b"\n".join(lines)


def _number(seen: int, back: re.Match[bytes]) -> bytes:
    return b" %d" % max(seen + 1 - int(back[1]), 0)  # before the first: 0, which is refused


MESH_SUFFIXES = (".obj", ".stl", ".ply")
DEPTH_MAP_SUFFIX = ".npy"
MAX_FACES = 2_000_000
"""So many are read in 2 s (binary .stl) to 16 s (.ply as text) and placed in 4 s, on two busy cores."""
MAX_BYTES = 2**28
"""A quarter of a gibibyte: as text, .stl takes 300 bytes a face, and four times that in memory while it is read."""
LARGEST = 1e30
"""Of a vertex's coordinates, in whatever unit: their squares stay finite."""
_FEWER = "reduce the mesh, or save it as binary"
MIN_CELLS, MAX_CELLS = 8, 256
DEEPEST_M = 10.0
"""No bench is deeper; a depth map in millimetres is."""

Up = Literal["y", "z"]


@dataclass(frozen=True)
class MeshFile:
    """A mesh as its file had it when it was read: what becomes of the file later changes nothing."""

    path: Path
    sha256: str
    """Of the content."""
    triangles: Float64 = field(repr=False, compare=False)
    """(n, 3, 3), in the file's unit and axes; parts joined."""


def read_mesh(path: Path) -> MeshFile:
    """A mesh with all its parts. Raises SceneError for a file without one, or with one that nobody could place."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise SceneError(f"{path} is no mesh: give a file that ends in {', '.join(MESH_SUFFIXES)}")
    with _readable(path, f"{suffix} file", "export it again, as triangles"):
        if (size := path.stat().st_size) > MAX_BYTES:
            raise SceneError(f"{path} has {size / 2**20:.0f} MiB: at most {MAX_BYTES >> 20} are read; {_FEWER}")
        content = path.read_bytes()
        parts = _parts(content, suffix)
        triangles = np.concatenate([np.empty((0, 3, 3)), *(_triangles(part) for part in parts)])
    if problem := _problem(triangles):
        raise SceneError(f"{path} {problem}")
    return MeshFile(path, hashlib.sha256(content).hexdigest(), triangles)


def upright(triangles: Float64, up: Up) -> Float64:
    """Triangles (n, 3, 3) turned so that the axis `up` of their file is y, and the side that faces the wall is -z.

    With z up, as CAD and Blender have it, that side is the file's +y: what an export with y up turns into -z too.
    """
    return triangles if up == "y" else triangles[..., [0, 2, 1]] * (1, 1, -1)


def read_depth_map(path: Path) -> Float32:
    """A depth map (n, n) in metres over the object box, NaN for background, from real numbers of any type.

    Raises SceneError where it is no such map.
    """
    with _readable(path, "depth map", "save one with numpy.save(file, depth_m)"):
        stored = np.lib.format.open_memmap(path, mode="r")  # no pickles; a header that claims too much costs nothing
    if stored.dtype.kind not in "fiu":
        raise SceneError(f"{path} holds {stored.dtype} values: a depth map holds real numbers, in metres")
    if stored.ndim != 2 or stored.shape[0] != stored.shape[1] or not MIN_CELLS <= len(stored) <= MAX_CELLS:
        size = f"(n, n) with n from {MIN_CELLS} to {MAX_CELLS}"
        raise SceneError(f"{path} has shape {stored.shape}: a depth map has shape {size}")
    surface = stored[~np.isnan(stored)]
    if surface.size and not (surface.min() >= 0 and surface.max() <= DEEPEST_M):
        worst = surface.min() if surface.min() < 0 else surface.max()
        raise SceneError(
            f"{path} has a depth of {worst:g} m: depths are in metres from the wall into the room, "
            f"0 to {DEEPEST_M:g} (negative is behind the wall), NaN for background"
        )
    return np.array(stored, np.float32)


@contextmanager
def _readable(path: Path, kind: str, advice: str) -> Generator[None]:
    """Whatever a missing or damaged file makes a parser raise, as one SceneError."""
    try:
        yield
    except SceneError:
        raise
    except OSError as error:
        raise SceneError(f"{path} cannot be read as a {kind}: {error.strerror or error}") from error
    except Exception as error:
        detail = " ".join(f"{type(error).__name__}: {error}".split())
        raise SceneError(f"{path} is damaged or no {kind} ({detail:.120}): {advice}") from error


@contextmanager
def _strict() -> Generator[None]:
    """Numbers that cannot be read are an error, and trimesh keeps its log to itself."""
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
    """Every mesh in a file, just as it is written. A stream has no folder to look for materials and textures in."""
    with _strict():
        stream = BytesIO(plain(content, suffix))
        scene = trimesh.load_scene(stream, suffix[1:], process=False, fix_texture=False)
    return [part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh)]


def _triangles(part: trimesh.Trimesh) -> Float64:
    faces = np.asarray(part.faces, np.int64).reshape(-1, 3)
    if faces.size and faces.min() < 0:
        raise ValueError(f"a face names vertex {faces.min()}")
    return np.asarray(part.vertices, np.float64)[faces]


def _problem(triangles: Float64) -> str:
    """Why nobody could place triangles (n, 3, 3); empty where one can."""
    if not len(triangles):
        return "has no faces: it is empty, cut short or a point cloud; export a mesh of triangles"
    if len(triangles) > MAX_FACES:
        return f"has {len(triangles)} faces: at most {MAX_FACES} are rendered; {_FEWER}"
    if not np.abs(triangles).max() <= LARGEST:  # false for NaN too
        return f"has a vertex that is NaN, infinite or beyond {LARGEST:g}: repair or export it again"
    extent = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    if not np.abs(normals).max() > 1e-12 * extent**2:
        return "has no face with an area: it is a point or a line; export a surface or a solid"
    return ""


POSES = 20
"""Poses that a mesh is tried at before it counts as one that shows nothing: a sheet may be seen edge on."""
Mesh = TypeVar("Mesh")


def folder_objects(folder: Path) -> list[Path]:
    """The meshes (.obj, .stl, .ply) of a folder and its subfolders, sorted by their place in it.

    What starts with a dot is passed over, as other programs hide their own files so. Raises SceneError where the folder
    cannot be looked through, or holds none.
    """
    if not folder.is_dir():
        raise SceneError(f"no folder {folder}: give one that holds meshes ({', '.join(MESH_SUFFIXES)})")
    found = [path for path in folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES and path.is_file()]
    meshes = {path.relative_to(folder).parts: path for path in found}
    seen = [meshes[parts] for parts in sorted(meshes) if not any(part.startswith(".") for part in parts)]
    if not seen:
        endings = ", ".join(MESH_SUFFIXES)
        raise SceneError(f"no meshes in {folder}: neither it nor its subfolders hold a file that ends in {endings}")
    return seen


def mesh_depth(
    seed: int,
    meshes: Sequence[Mesh],
    box: ObjectBox,
    up: Up = "y",
    *,
    read: Callable[[Mesh], MeshFile],
) -> tuple[Mesh, Float32]:
    """One of the meshes and its depth map (64, 64) in metres, NaN background; the seed picks it and its pose.

    It is placed as procedural objects are, whatever the unit of its file; where a pose shows no surface, at the next.
    Only the mesh that is picked is read. Raises SceneError, which names the file, for one that shows none at all.
    """
    generator = np.random.default_rng([seed, OBJECT_PIXELS])
    picked = meshes[int(generator.integers(len(meshes)))]
    mesh = read(picked)
    triangles = upright(mesh.triangles, up)
    for _ in range(POSES):
        depth_m = orthographic_depth(place(triangles, random_pose(generator, box), box), box)
        if not np.isnan(depth_m).all():
            return picked, depth_m
    raise SceneError(
        f"{mesh.path} shows no surface from any of {POSES} poses: it is thinner than a cell of the depth map; take it "
        "out of the folder, or make it thicker"
    )
