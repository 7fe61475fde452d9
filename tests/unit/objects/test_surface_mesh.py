"""Mesh of a hidden surface: sampled at the cells' centres it is the depth map; other readers find the same mesh."""

import csv
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from nlos_calibration import ObjectBox

from nlos_cam.errors import NlosCamError
from nlos_cam.objects import SurfaceMesh, cell_centers_m, mesh_from_depth, orthographic_depth
from nlos_cam.objects.surface_mesh import JUMP_M

BOX = ObjectBox(x_min_m=0.0, x_max_m=0.16, y_min_m=-0.1, y_max_m=0.06, z_near_m=0.1, z_far_m=0.6)
NAN = np.float32(np.nan)
DEPTHS = arrays(np.float32, (8, 8), elements=st.one_of(st.just(NAN), st.floats(0.125, 0.25, width=32)))
ERROR_M = np.linspace(0.001, 0.05, 64, dtype=np.float32).reshape(8, 8)


def slope() -> np.ndarray:
    """Return a tilted plane with a hole, a line one cell wide and a single cell."""
    depth_m = np.full((8, 8), NAN)
    depth_m[:4, :5] = 0.2 + 0.004 * np.arange(20, dtype=np.float32).reshape(4, 5)
    depth_m[1, 1], depth_m[6, :4], depth_m[7, 7] = NAN, 0.3, 0.15
    return depth_m


def sampled(mesh: SurfaceMesh) -> np.ndarray:
    """Return the mesh's depth at the cells' centres; triangles grow by 1e-7 so that a centre on an edge is inside."""
    triangles_m = mesh.vertices_m[mesh.faces]
    middle_m = triangles_m.mean(axis=1, keepdims=True)
    return orthographic_depth(middle_m + (1 + 1e-7) * (triangles_m - middle_m), BOX, 8)


@given(depth_m=DEPTHS, jump_m=st.sampled_from([0.0, JUMP_M, 1.0]))
def test_mesh_sampled_at_cell_centers_is_the_depth_map(depth_m: np.ndarray, jump_m: float) -> None:
    mesh = mesh_from_depth(depth_m, BOX, ERROR_M, jump_m)
    np.testing.assert_allclose(sampled(mesh), depth_m, atol=1e-6)
    corners_m = mesh.vertices_m[mesh.faces]
    assert not len(corners_m) or np.ptp(corners_m[..., 2], axis=1).max() <= jump_m + 1e-7
    normal = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    assert (normal[:, 2] < 0).all(), "the lit side faces the wall"


def test_vertices_lie_at_cell_centers_with_their_uncertainty() -> None:
    x_m, y_m = cell_centers_m(BOX, 8)
    mesh = mesh_from_depth(np.full((8, 8), 0.2, np.float32), BOX, ERROR_M)
    np.testing.assert_allclose(mesh.vertices_m[9], [x_m[1], y_m[1], 0.2], atol=1e-8)
    np.testing.assert_array_equal(mesh.uncertainty_m, ERROR_M.ravel())


def read_glb(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and uncertainty as the glTF 2.0 specification defines them."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]

    def values(number: int, kind: str) -> np.ndarray:
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        count = accessor["count"] * {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        return np.frombuffer(binary, kind, count, view.get("byteOffset", 0) + accessor.get("byteOffset", 0))

    named = primitive["attributes"]
    kind = {5123: "<u2", 5125: "<u4"}[tree["accessors"][primitive["indices"]]["componentType"]]
    assert tree["materials"][primitive["material"]]["doubleSided"]
    faces = values(primitive["indices"], kind).reshape(-1, 3)
    return values(named["POSITION"], "<f4").reshape(-1, 3), faces, values(named["_uncertainty_m"], "<f4")


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_opencv_reads_the_saved_mesh(tmp_path: Path, suffix: str) -> None:
    mesh = mesh_from_depth(slope(), BOX, ERROR_M)
    mesh.save(tmp_path / f"mesh{suffix}")
    vertices_m, faces, *_ = cv2.loadMesh(str(tmp_path / f"mesh{suffix}"))
    read = SurfaceMesh(np.float64(vertices_m[0]), np.array(faces, np.int64).reshape(-1, 3))
    np.testing.assert_allclose(read.vertices_m, mesh.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert [path.name for path in tmp_path.iterdir()] == [f"mesh{suffix}"]


def test_glb_holds_the_mesh_and_its_uncertainty(tmp_path: Path) -> None:
    mesh = mesh_from_depth(slope(), BOX, ERROR_M)
    mesh.save(tmp_path / "mesh.glb")
    vertices_m, faces, uncertainty_m = read_glb(tmp_path / "mesh.glb")
    np.testing.assert_allclose(vertices_m, mesh.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_array_equal(uncertainty_m, mesh.uncertainty_m)


def test_points_are_saved_without_faces(tmp_path: Path) -> None:
    mesh = mesh_from_depth(slope(), BOX)
    mesh.points_only.save(tmp_path / "points.ply")
    read, *_ = cv2.loadPointCloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(read[:, 0], mesh.vertices_m, atol=1e-6)
    mesh.save(str(tmp_path / "points.csv"))
    rows = [*csv.DictReader((tmp_path / "points.csv").read_text(encoding="utf-8").splitlines())]
    np.testing.assert_allclose([float(row["z_m"]) for row in rows], mesh.vertices_m[:, 2], atol=1e-5)
    assert {row["uncertainty_m"] for row in rows} == {""}
    mesh_from_depth(slope(), BOX, ERROR_M).save(tmp_path / "mesh.npz")
    with np.load(tmp_path / "mesh.npz") as arrays_read:
        np.testing.assert_array_equal(arrays_read["vertices_m"], mesh.vertices_m)
        assert len(arrays_read["uncertainty_m"]) == len(mesh.vertices_m)


@pytest.mark.parametrize(("name", "depth_m", "word"), [("a.fbx", 0.2, ".glb"), ("a.ply", NAN, "no surface")])
def test_mesh_that_cannot_be_saved_is_refused(tmp_path: Path, name: str, depth_m: float, word: str) -> None:
    with pytest.raises(NlosCamError, match=word):
        mesh_from_depth(np.full((8, 8), depth_m, np.float32), BOX).save(tmp_path / name)
    assert not any(tmp_path.iterdir())
