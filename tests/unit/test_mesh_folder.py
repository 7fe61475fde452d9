"""Meshes of a folder and its subfolders: which are found, in which order, and what a seed makes of them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from nlos_calibration.rig import ObjectBox, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import meshes as mesh_folder
from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.meshes import POSES, MeshFile, folder_objects, mesh_depth, read_mesh
from nlos_cam.objects.placement import Pose, random_pose

BOX = object_box(load_rig("paper-rig"))
TORUS = trimesh.creation.torus(30, 10, major_sections=16, minor_sections=8)


def _save(path: Path, mesh: trimesh.Trimesh = TORUS) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path, file_type=path.suffix[1:].lower())
    return path


def test_meshes_of_all_depths_are_found_in_one_order(tmp_path: Path) -> None:
    names = ["b.obj", "a/z.STL", "a/deep/er/y.ply", "c/x.stl"]
    for name in names:
        _save(tmp_path / name)
    for other in ("readme.txt", ".hidden/w.stl", "._b.obj", "a/picture.png"):
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).write_bytes(b"no mesh")
    (tmp_path / "folder.obj").mkdir()
    found = [path.relative_to(tmp_path).as_posix() for path in folder_objects(tmp_path)]
    assert found == ["a/deep/er/y.ply", "a/z.STL", "b.obj", "c/x.stl"]


def test_a_folder_inside_a_hidden_one_is_looked_through(tmp_path: Path) -> None:
    _save(tmp_path / ".cache" / "meshes" / "a.stl")
    assert len(folder_objects(tmp_path / ".cache" / "meshes")) == 1


def test_an_empty_folder_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    with pytest.raises(SceneError, match=r"no meshes in .*: neither .* \.obj, \.stl, \.ply$"):
        folder_objects(tmp_path)


def test_a_missing_folder_and_a_file_are_no_folders(tmp_path: Path) -> None:
    for path in (tmp_path / "gone", _save(tmp_path / "a.stl")):
        with pytest.raises(SceneError, match=f"no folder {path}"):
            folder_objects(path)


def test_a_seed_is_one_mesh_at_one_pose_inside_the_box(tmp_path: Path) -> None:
    meshes = [_save(tmp_path / "a.stl"), _save(tmp_path / "b.ply", trimesh.creation.box((3, 2, 1)))]
    made = [mesh_depth(seed, meshes, BOX, read=read_mesh) for seed in range(12)]
    assert {path for path, _ in made} == set(meshes)
    assert len({depth.tobytes() for _, depth in made}) == 12
    for seed, (path, depth) in enumerate(made):
        again = mesh_depth(seed, meshes, BOX, read=read_mesh)
        assert again[0] == path
        np.testing.assert_array_equal(again[1], depth)
        assert depth.shape == (64, 64)
        assert BOX.z_near_m - 1e-6 <= np.nanmin(depth) <= np.nanmax(depth) <= BOX.z_far_m + 1e-6
        assert 0.03 < np.isfinite(depth).mean() < 0.85


def test_its_unit_does_not_matter_and_which_axis_is_up_does(tmp_path: Path) -> None:
    millimetres = _save(tmp_path / "mm.stl")
    metres = _save(tmp_path / "m.stl", TORUS.copy().apply_scale(0.001))
    first, other = (mesh_depth(5, [path], BOX, read=read_mesh)[1] for path in (millimetres, metres))
    assert (np.isfinite(first) != np.isfinite(other)).sum() <= 3
    both = np.isfinite(first) & np.isfinite(other)
    np.testing.assert_allclose(first[both], other[both], atol=1e-3)
    lying = mesh_depth(5, [millimetres], BOX, up="z", read=read_mesh)[1]
    assert (np.isfinite(lying) != np.isfinite(first)).sum() > 100


def test_a_broken_mesh_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.ply").write_bytes(b"ply\nnothing")
    with pytest.raises(SceneError, match=r"broken\.ply"):
        mesh_depth(0, folder_objects(tmp_path), BOX, read=read_mesh)


def test_a_mesh_that_shows_nothing_is_named(tmp_path: Path) -> None:
    needle = trimesh.Trimesh([[0, 0, 0], [0, 1, 0], [1e-5, 0.5, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(SceneError, match=r"needle\.ply shows no surface .*out of the folder"):
        mesh_depth(0, [_save(tmp_path / "needle.ply", needle)], BOX, read=read_mesh)


def test_only_the_mesh_that_is_picked_is_read() -> None:
    """However many a folder holds, and whatever names them."""
    read: list[str] = []

    def ball(name: str) -> MeshFile:
        read.append(name)
        return MeshFile(Path(name), "", np.asarray(TORUS.triangles, np.float64))

    names = [f"mesh-{k}" for k in range(1000)]
    assert [mesh_depth(seed, names, BOX, read=ball)[0] for seed in range(4)] == read


def test_a_sheet_that_is_seen_edge_on_gets_another_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    poses: list[Pose] = []

    def first_along_the_sight(generator: np.random.Generator, box: ObjectBox) -> Pose:
        poses.append(Pose() if not poses else random_pose(generator, box))
        return poses[-1]

    monkeypatch.setattr(mesh_folder, "random_pose", first_along_the_sight)
    lying = np.array([[[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[1, 0, 0], [1, 0, 1], [0, 0, 1]]], np.float64)
    _, depth_m = mesh_depth(3, ["sheet"], BOX, read=lambda name: MeshFile(Path(name), "", lying))
    assert 1 < len(poses) <= POSES
    assert np.isfinite(depth_m).any()
