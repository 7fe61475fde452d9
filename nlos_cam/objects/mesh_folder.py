"""Hidden objects from a folder of meshes: which files it holds, and one of them at a random pose for each seed."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from nlos_calibration.rig import ObjectBox

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS, Float32
from nlos_cam.objects.files import MESH_SUFFIXES, MeshFile, Up, upright
from nlos_cam.objects.hidden import place, random_pose
from nlos_cam.objects.raster import orthographic_depth

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
