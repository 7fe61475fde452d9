"""Hidden objects from a folder of meshes: which files it holds, and one of them at a random pose for each seed."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from nlos_calibration.rig import ObjectBox

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS, Float32
from nlos_cam.objects.files import MESH_SUFFIXES, MeshFile, Up, read_mesh, upright
from nlos_cam.objects.hidden import nothing_to_see, place, random_pose
from nlos_cam.objects.raster import orthographic_depth


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
    meshes: Sequence[Path],
    box: ObjectBox,
    up: Up = "y",
    *,
    read: Callable[[Path], MeshFile] = read_mesh,
) -> tuple[Path, Float32]:
    """One of the meshes and its depth map (64, 64) in metres, NaN background; the seed picks it and its pose.

    It is placed as procedural objects are, whatever the unit of its file. `read` may keep what it has read. Raises
    SceneError, which names the file, for one that cannot be read or shows no surface.
    """
    generator = np.random.default_rng([seed, OBJECT_PIXELS])
    path = meshes[int(generator.integers(len(meshes)))]
    triangles = upright(read(path).triangles, up)
    depth_m = orthographic_depth(place(triangles, random_pose(generator, box), box), box)
    if np.isnan(depth_m).all():
        raise nothing_to_see(str(path), box)
    return path, depth_m
