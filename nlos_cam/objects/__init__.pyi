__all__ = [
    "CATEGORIES",
    "DEPTH_MAP_SUFFIX",
    "JUMP_M",
    "MAX_UNCERTAINTY_M",
    "MESH_SUFFIXES",
    "OBJECTS_PER_CATEGORY",
    "TEXTURES",
    "TRUTH_SUFFIX",
    "BenchmarkObject",
    "Coat",
    "MeshFile",
    "Pose",
    "SurfaceMesh",
    "Up",
    "benchmark_objects",
    "box_width_m",
    "category_triangles",
    "cell_centers_m",
    "depth_from_image",
    "find_category",
    "folder_objects",
    "generic_depth",
    "image_from_albedo",
    "image_from_depth",
    "invisible_object_error",
    "load_object",
    "mesh_depth",
    "mesh_from_depth",
    "object_box",
    "object_depth",
    "object_kind",
    "orthographic_depth",
    "paint",
    "panel",
    "place",
    "post",
    "random_pose",
    "read_depth_map",
    "read_mesh",
    "triangulate",
    "turn_upright",
    "unseen_objects",
    "without_absent",
]

from .benchmark import OBJECTS_PER_CATEGORY, BenchmarkObject, benchmark_objects, unseen_objects
from .depth_map import (
    cell_centers_m,
    depth_from_image,
    image_from_depth,
    object_box,
    orthographic_depth,
)
from .generators import CATEGORIES, find_category
from .generic import generic_depth
from .loading import load_object, object_kind, without_absent
from .meshes import (
    DEPTH_MAP_SUFFIX,
    MESH_SUFFIXES,
    TRUTH_SUFFIX,
    MeshFile,
    Up,
    folder_objects,
    mesh_depth,
    read_depth_map,
    read_mesh,
    turn_upright,
)
from .placement import (
    Pose,
    box_width_m,
    category_triangles,
    invisible_object_error,
    object_depth,
    panel,
    place,
    post,
    random_pose,
)
from .polygons import triangulate
from .surface_mesh import JUMP_M, MAX_UNCERTAINTY_M, SurfaceMesh, mesh_from_depth
from .textures import TEXTURES, Coat, image_from_albedo, paint
