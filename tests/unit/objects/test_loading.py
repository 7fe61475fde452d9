"""Objects by name: categories, meshes and depth maps give depth maps; unknown names suggest the nearest category."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from nlos_calibration import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import Pose, category_triangles, find_category, load_object, object_box, orthographic_depth, place

BOX = object_box(load_rig("paper-rig"))
POSE = Pose(size_m=0.15, tilt_y_rad=0.3)


def test_load_object_places_a_category_and_a_mesh_alike(tmp_path: Path) -> None:
    triangles = category_triangles("cup", 4)
    corners = triangles.reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    mesh.export(tmp_path / "cup.stl")
    expected = orthographic_depth(place(triangles, POSE, BOX), BOX)
    loaded = load_object("cup", BOX, POSE, seed=4)
    np.testing.assert_array_equal(loaded.depth_m, expected)
    assert loaded.warnings == ()
    np.testing.assert_allclose(load_object(str(tmp_path / "cup.stl"), BOX, POSE).depth_m, expected, atol=1e-4)


@pytest.mark.parametrize(("name", "hint"), [("cupp", "Did you mean 'cup'?"), ("teapot", "tower"), ("cup.glb", ".stl")])
def test_load_object_suggests_the_nearest_category(name: str, hint: str) -> None:
    with pytest.raises(SceneError) as caught:
        load_object(name, BOX)
    assert name in str(caught.value)
    assert hint in str(caught.value)
    with pytest.raises(SceneError, match="Did you mean 'airplane'"):
        find_category("aeroplane")


@pytest.mark.parametrize(
    ("name", "arguments"), [("cup", {"up": "z"}), ("a.stl", {"seed": 1}), ("a.npy", {"pose": POSE})]
)
def test_load_object_refuses_arguments_that_do_not_apply(name: str, arguments: dict[str, object]) -> None:
    with pytest.raises(SceneError, match="seed is for categories"):
        load_object(name, BOX, **arguments)  # type: ignore[arg-type]


def test_load_object_refuses_a_plate_seen_edge_on(tmp_path: Path) -> None:
    plate = tmp_path / "plate.obj"
    plate.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"plate\.obj"):
        load_object(str(plate), BOX, Pose(tilt_y_rad=np.pi / 2))
