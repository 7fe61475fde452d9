"""Scenes whose object is a mesh's file: where its path starts, how it moves, and the checksum that is its content."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from nlos_calibration.rig import dump_toml

from nlos_cam.errors import SceneError
from nlos_cam.objects.meshes import read_mesh
from nlos_cam.render.scene_file import SceneFile, load_scene

WEDGE = """
name = "wedge"
rig = "paper-rig"

[object]
file = "things/wedge.stl"
size_m = 0.15

[motion]
poses = 8
sway_x_m = 0.03
turn_deg = 20.0
"""
CUP = WEDGE.replace('file = "things/wedge.stl"', 'category = "cup"\nseed = 3')


def _load(folder: Path, text: str) -> SceneFile:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return load_scene(path)


def _wedge(folder: Path, height: float = 0.6) -> Path:
    (folder / "things").mkdir(exist_ok=True)
    corners = [(0, 0, 0), (1, 0, 0), (0, height, 0), (0, 0, 0.4)]
    solid = trimesh.Trimesh(corners, [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], process=False)
    solid.export(folder / "things" / "wedge.stl")
    return folder / "things" / "wedge.stl"


def test_a_meshs_path_starts_from_the_scenes_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _wedge(tmp_path)
    monkeypatch.chdir(tmp_path.parent)
    scene = _load(tmp_path, WEDGE)
    assert scene.hidden is not None
    assert scene.hidden.file == read_mesh(path)
    assert scene.shows_at(0)


def test_a_scene_with_a_mesh_survives_a_file_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _wedge(tmp_path)
    monkeypatch.chdir(tmp_path)
    scene = _load(Path(), WEDGE.replace("[motion]", 'up = "z"\n\n[motion]'))
    (tmp_path / "elsewhere").mkdir()
    again = _load(tmp_path / "elsewhere", dump_toml(scene))
    assert again == scene
    assert again.checksum == scene.checksum


def test_a_mesh_moves_as_a_category_does(tmp_path: Path) -> None:
    """The category itself, from a file: every instant of the loop is the same but for single precision."""
    cup = _load(tmp_path, CUP)
    assert cup.hidden is not None
    triangles = cup.hidden.triangles
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    mesh.export(tmp_path / "cup.stl")
    read = _load(tmp_path, CUP.replace('category = "cup"\nseed = 3', 'file = "cup.stl"'))
    for number in range(cup.poses):
        depths = [np.nan_to_num(s.scene_at(number).object_depth_m, nan=1.0) for s in (cup, read)]
        assert (np.abs(depths[0] - depths[1]) > 1e-5).sum() <= 3


def test_the_checksum_is_the_meshs_content_and_axes_and_not_its_path(tmp_path: Path) -> None:
    path = _wedge(tmp_path)
    first = _load(tmp_path, WEDGE).checksum
    assert _load(tmp_path, WEDGE.replace('wedge.stl"', 'wedge.stl"\nup = "z"')).checksum != first
    assert _load(tmp_path, CUP).checksum != first
    path.rename(tmp_path / "moved.stl")
    assert _load(tmp_path, WEDGE.replace("things/wedge", "moved")).checksum == first
    _wedge(tmp_path, height=0.61)
    assert _load(tmp_path, WEDGE).checksum != first


def test_a_scene_keeps_the_mesh_that_it_was_loaded_with(tmp_path: Path) -> None:
    """Or half of a loop would be of one mesh and half of another, cached under the name of the first."""
    _wedge(tmp_path)
    scene = _load(tmp_path, WEDGE)
    before, depth = scene.checksum, scene.scene_at(1).object_depth_m
    _wedge(tmp_path, height=0.3)
    assert scene.checksum == before
    np.testing.assert_array_equal(scene.scene_at(1).object_depth_m, depth)


def test_a_file_has_no_variations(tmp_path: Path) -> None:
    _wedge(tmp_path)
    with pytest.raises(SceneError, match="object: seed is for a category"):
        _load(tmp_path, WEDGE.replace('wedge.stl"', 'wedge.stl"\nseed = 1'))
