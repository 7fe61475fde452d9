"""Hidden objects from files: triangle meshes (.obj, .stl, .ply) and depth maps (.npy)."""

import hashlib
import logging
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from nlos_cam.errors import SceneError
from nlos_cam.frames import Float32
from nlos_cam.objects.hidden import Triangles
from nlos_cam.objects.mesh_text import plain

MESH_SUFFIXES = (".obj", ".stl", ".ply")
DEPTH_MAP_SUFFIX = ".npy"
MOST_FACES = 2_000_000
"""So many are read in 2 s (binary .stl) to 16 s (.ply as text) and placed in 4 s, on two busy cores."""
MOST_BYTES = 2**28
"""A quarter of a gibibyte: as text, .stl takes 300 bytes a face, and four times that in memory while it is read."""
LARGEST = 1e30
"""Of a vertex's coordinates, in whatever unit: their squares stay finite."""
_FEWER = "reduce the mesh, or save it as binary"
LEAST_CELLS, MOST_CELLS = 8, 256
DEEPEST_M = 10.0
"""No bench is deeper; a depth map in millimetres is."""

Up = Literal["y", "z"]


@dataclass(frozen=True)
class MeshFile:
    """A mesh as its file had it when it was read: what becomes of the file later changes nothing."""

    path: Path
    sha256: str
    """Of the content."""
    triangles: Triangles = field(repr=False, compare=False)
    """(n, 3, 3), in the file's unit and axes; parts joined."""


def read_mesh(path: Path) -> MeshFile:
    """A mesh with all its parts. Raises SceneError for a file without one, or with one that nobody could place."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise SceneError(f"{path} is no mesh: give a file that ends in {', '.join(MESH_SUFFIXES)}")
    with _readable(path, f"{suffix} file", "export it again, as triangles"):
        if (size := path.stat().st_size) > MOST_BYTES:
            raise SceneError(f"{path} has {size / 2**20:.0f} MiB: at most {MOST_BYTES >> 20} are read; {_FEWER}")
        content = path.read_bytes()
        parts = _parts(content, suffix)
        triangles = np.concatenate([np.empty((0, 3, 3)), *(_triangles(part) for part in parts)])
    if problem := _problem(triangles):
        raise SceneError(f"{path} {problem}")
    return MeshFile(path, hashlib.sha256(content).hexdigest(), triangles)


def upright(triangles: Triangles, up: Up) -> Triangles:
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
    if stored.ndim != 2 or stored.shape[0] != stored.shape[1] or not LEAST_CELLS <= len(stored) <= MOST_CELLS:
        size = f"(n, n) with n from {LEAST_CELLS} to {MOST_CELLS}"
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


def _triangles(part: trimesh.Trimesh) -> Triangles:
    faces = np.asarray(part.faces, np.int64).reshape(-1, 3)
    if faces.size and faces.min() < 0:
        raise ValueError(f"a face names vertex {faces.min()}")
    return np.asarray(part.vertices, np.float64)[faces]


def _problem(triangles: Triangles) -> str:
    """Why nobody could place triangles (n, 3, 3); empty where one can."""
    if not len(triangles):
        return "has no faces: it is empty, cut short or a point cloud; export a mesh of triangles"
    if len(triangles) > MOST_FACES:
        return f"has {len(triangles)} faces: at most {MOST_FACES} are rendered; {_FEWER}"
    if not np.abs(triangles).max() <= LARGEST:  # false for NaN too
        return f"has a vertex that is NaN, infinite or beyond {LARGEST:g}: repair or export it again"
    extent = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    if not np.abs(normals).max() > 1e-12 * extent**2:
        return "has no face with an area: it is a point or a line; export a surface or a solid"
    return ""
