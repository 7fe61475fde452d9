"""Objects by name: a category, a mesh file or a depth-map file, as a depth map over the object
box.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.errors import SceneError, UnknownNameError, did_you_mean
from nlos_cam.objects.depth_map import orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.meshes import (
    DEPTH_MAP_SUFFIX,
    MESH_SUFFIXES,
    Up,
    read_depth_map,
    read_mesh,
    turn_upright,
)
from nlos_cam.objects.placement import (
    Pose,
    category_triangles,
    fit_in_box,
    invisible_object_error,
    place,
)

OBJECT_FILES = (
    f"a mesh ({', '.join(MESH_SUFFIXES)}), a {DEPTH_MAP_SUFFIX} depth map (n, n) in metres"
)

ObjectKind = Literal["category", "mesh", "depth map"]


@dataclass(frozen=True)
class LoadedObject:
    """Hidden object as a depth map."""

    depth_m: Float32
    """(n, n) over the object box, NaN for background."""
    warnings: tuple[str, ...] = ()
    """One sentence for each change that the box made, or for an empty depth map."""


def object_kind(name_or_path: str) -> ObjectKind:
    """Return the kind of an object by its name or file suffix. Raises UnknownNameError, with the
    nearest category.
    """
    suffix = Path(name_or_path).suffix.lower()
    if name_or_path in CATEGORIES:
        return "category"
    if suffix in MESH_SUFFIXES:
        return "mesh"
    if suffix == DEPTH_MAP_SUFFIX:
        return "depth map"
    advice = f"Give {OBJECT_FILES}, or one of {', '.join(CATEGORIES)}"
    raise UnknownNameError(
        f"no object {name_or_path!r}.{did_you_mean(name_or_path, CATEGORIES)} {advice}"
    )


def load_object(
    name_or_path: str, box: ObjectBox, pose: Pose | None = None, *, seed: int = 0, up: Up = "y"
) -> LoadedObject:
    """Return the depth map of a category (variation `seed`), a mesh (axis `up` upwards) or a
    depth-map file.

    `pose` places a category or a mesh (default: `Pose()`). Raises SceneError for an unknown name, a
    file that cannot be read, an argument that the kind of object does not take, or an object
    without any surface in the box.
    """
    kind = object_kind(name_or_path)
    label = name_or_path
    if (
        (kind != "category" and seed)
        or (kind != "mesh" and up != "y")
        or (kind == "depth map" and pose is not None)
    ):
        raise SceneError(
            f"{label} is a {kind}: seed is for categories, up for meshes, and a depth map takes no"
            " pose"
        )
    if kind == "depth map":
        depth_m, notes = without_absent(read_depth_map(Path(label)), label, box)
        if np.isnan(depth_m).all():
            notes += (f"{label} is an empty object (all NaN or 0): it hides nothing",)
        return LoadedObject(depth_m, notes)
    triangles = (
        category_triangles(label, seed)
        if kind == "category"
        else turn_upright(read_mesh(Path(label)).triangles, up)
    )
    pose = pose or Pose()
    depth_m = orthographic_depth(place(triangles, pose, box), box)
    if np.isnan(depth_m).all():
        raise invisible_object_error(label, box)
    fit = fit_in_box(triangles, pose, box)
    warnings = _vanishing(label, triangles, depth_m)
    if fit.outside:
        warnings.append(
            f"{label}: {fit.outside:.0%} of its silhouette lies outside the object box and is"
            " cut off"
        )
    if fit.depth_m > fit.room_m:
        warnings.append(
            f"{label}: {fit.depth_m:.3g} m deep, flattened to the {fit.room_m:.3g} m left in the"
            " object box"
        )
    return LoadedObject(depth_m, tuple(warnings))


FEW_CELLS = 10
FAR_FACES = 5.0
"""Extents of the rest of a mesh from which on a face counts as far from it."""
FEW_FACES = 0.05


def without_absent(depth_m: Float32, label: str, box: ObjectBox) -> tuple[Float32, tuple[str, ...]]:
    """Return a depth map with NaN where a depth of 0 stands for "no data", and what was changed or
    lies behind the box.

    Depth cameras write 0 there, and a depth of 0 is the relay wall itself. Raises SceneError for
    other depths nearer than the box.
    """
    absent = depth_m == 0
    found = np.where(absent, np.float32(np.nan), depth_m)
    nearer = int((found < box.z_near_m).sum())
    if nearer:
        raise SceneError(
            f"{label} has {nearer} of {depth_m.size} cells nearer than the object box"
            f" ({box.z_near_m:g} m from the wall): depths are from the wall into the room, NaN or 0"
            " for background"
        )
    notes = list[str]()
    if absent.any():
        notes.append(f"{label}: {absent.sum()} cells with a depth of 0 are taken as background")
    if farther := int((found > np.float32(box.z_far_m)).sum()):
        notes.append(
            f"{label}: {farther} of its {depth_m.size} cells lie behind the object box"
            f" ({box.z_far_m:g} m from the wall), where no reconstruction can place them"
        )
    return found, tuple(notes)


def _vanishing(label: str, triangles: Float64, depth_m: Float32) -> list[str]:
    """Return warnings on an object of which next to nothing is left to see."""
    warnings = list[str]()
    covered = int(np.isfinite(depth_m).sum())
    if covered < FEW_CELLS:
        warnings.append(
            f"{label} covers {covered} of {depth_m.size} cells of the object box: next to nothing"
            " is hidden"
        )
    centers = triangles.mean(1)
    middle = np.median(centers, axis=0)
    distance = np.linalg.norm(centers - middle, axis=1)
    extent = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    # The size of the bulk of the mesh: of all but the farthest faces.
    bulk = 2 * np.quantile(distance, 1 - FEW_FACES, method="lower")
    far = distance > FAR_FACES * max(bulk, 1e-12)
    if far.any() and far.mean() < 0.5 and extent > FAR_FACES * bulk:
        warnings.append(
            f"{label}: {far.sum()} of its {len(far)} faces lie {distance[far].max():.3g} units away"
            " from the others, and the size counts them: remove them"
        )
    return warnings
