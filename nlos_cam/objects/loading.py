"""Objects by name: a category, a mesh file or a depth-map file, as a depth map over the object
box.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32

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
        depth_m = read_depth_map(Path(label))
        empty = f"{label} is an empty object (all NaN): it hides nothing"
        return LoadedObject(depth_m, (empty,) if np.isnan(depth_m).all() else ())
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
    warnings = list[str]()
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
