"""OBJECT and its options: the depth map is the scene file's, and what is cut, flattened or refused is told."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import typer
from nlos_calibration.rig import Rig, load_rig

from nlos_cam.cli.render import hidden_depth
from nlos_cam.errors import SceneError
from nlos_cam.objects.meshes import read_mesh
from nlos_cam.render.scene_file import HiddenObject, SceneFile

RIG = load_rig("paper-rig")
POSES: list[dict[str, Any]] = [
    {},
    {"size_m": 0.1},
    {"tilt_x_deg": 30},
    {"tilt_y_deg": -25},
    {"turn_deg": 45},
    {"x_m": 0.02},
    {"y_m": -0.03},
    {"front_m": 0.1},
    {"size_m": 0.12, "turn_deg": 10, "x_m": 0.03, "front_m": 0.0},
]


@pytest.fixture
def mesh(tmp_path: Path) -> str:
    corners = [(0, 0, 0), (1, 0, 0), (0, 0.6, 0), (0, 0, 0.4)]
    solid = trimesh.Trimesh(corners, [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], process=False)
    solid.export(tmp_path / "wedge [b].stl")
    return str(tmp_path / "wedge [b].stl")


def _of_scene(rig: Rig = RIG, **fields: Any) -> np.ndarray:
    depth_m = SceneFile(name="same", rig=rig, object=HiddenObject(**fields)).scene_at(0).object_depth_m
    assert depth_m is not None
    return depth_m


@pytest.mark.parametrize("pose", POSES)
def test_every_option_means_what_it_means_in_a_scene_file(
    mesh: str, pose: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    np.testing.assert_array_equal(hidden_depth("hat", RIG, pose), _of_scene(category="hat", **pose))
    np.testing.assert_array_equal(hidden_depth(mesh, RIG, pose), _of_scene(file=read_mesh(Path(mesh)), **pose))
    if pose:
        assert not np.array_equal(hidden_depth(mesh, RIG, pose), hidden_depth(mesh, RIG, {}), equal_nan=True)
    assert capsys.readouterr().err == ""


def test_seed_and_up_go_with_what_has_them(mesh: str) -> None:
    np.testing.assert_array_equal(hidden_depth("hat", RIG, {"seed": 7}), _of_scene(category="hat", seed=7))
    z_up = hidden_depth(mesh, RIG, {"up": "z"})
    np.testing.assert_array_equal(z_up, _of_scene(file=read_mesh(Path(mesh)), up="z"))
    assert not np.array_equal(z_up, hidden_depth(mesh, RIG, {"up": "y"}), equal_nan=True)


def test_what_is_none_is_not_given(mesh: str) -> None:
    options = {"seed": None, "up": None, "size_m": None}
    np.testing.assert_array_equal(hidden_depth(mesh, RIG, options), hidden_depth(mesh, RIG, {}))


def test_a_depth_map_is_taken_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    depth = _of_scene(category="hat")
    np.save(tmp_path / "hat.NPY.npy", depth)
    np.testing.assert_array_equal(hidden_depth(str(tmp_path / "hat.NPY.npy"), RIG, {"size_m": None}), depth)
    assert capsys.readouterr().err == ""


def test_an_empty_depth_map_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "none [b].npy", np.full((64, 64), np.nan))
    assert np.isnan(hidden_depth(str(tmp_path / "none [b].npy"), RIG, {})).all()
    told = capsys.readouterr().err
    assert "none [b].npy is an empty object" in told
    assert told.count("\n") == 1


def test_what_sticks_out_of_the_box_is_cut_and_told(mesh: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Half a wide plate: the box ends in its middle."""
    plate = str(Path(mesh).with_name("plate [b].ply"))
    trimesh.creation.box(extents=(1, 0.2, 0.01)).export(plate)
    depth = hidden_depth(plate, RIG, {"size_m": 0.2, "x_m": 0.125})
    told = capsys.readouterr().err
    assert f"{plate}: 50% of its silhouette is outside the object box" in told
    assert told.count("\n") == 1
    assert np.isfinite(depth[:, -1]).any()
    assert np.isnan(depth[:, 0]).all()


def test_what_is_too_deep_is_flattened_and_told(mesh: str, capsys: pytest.CaptureFixture[str]) -> None:
    depth = hidden_depth(mesh, RIG, {"tilt_y_deg": 90, "front_m": 0.2})
    assert RIG.object_box is not None
    assert np.nanmax(depth) <= RIG.object_box.z_far_m + 1e-6
    told = capsys.readouterr().err
    assert f"{mesh}: 0.3 m deep, flattened to the 0.08 m" in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("map.npy", {"size_m": 0.1, "seed": None, "up": "z"}, "placed already: leave out --size-m, --up"),
        ("map.npy", {"seed": 0}, "leave out --seed"),
        ("cup", {"up": "y", "size_m": 0.1}, "category.*leave out --up$"),
        ("thing.obj", {"seed": 1, "turn_deg": 3}, "mesh.*leave out --seed$"),
        ("cup", {"size_m": float("nan")}, r"size_m: must be from 0\.001 to 10 \(got nan\)"),
        ("cup", {"turn_deg": float("inf")}, r"turn_deg: must be from -360 to 360 \(got inf\)"),
        ("cup", {"front_m": -0.1}, r"front_m: must be from 0 to 10 \(got -0\.1\)"),
        ("cup", {"seed": -1}, r"seed.*greater than or equal to 0 \(got -1\)"),
    ],
)
def test_options_that_cannot_be_are_wrong_usage(name: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(typer.BadParameter, match=words):
        hidden_depth(name, RIG, options)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("teapot", {}, r"no object 'teapot'.*\.obj, \.stl, \.ply.*\.npy.*airplane.*tower"),
        ("thing.glb", {}, r"no object 'thing\.glb'.*\.obj"),
        ("none.PLY", {}, r"none\.PLY cannot be read"),
        ("none.NPY", {}, r"none\.NPY cannot be read"),
        ("cup", {"x_m": 1}, r"cup shows no surface in the object box \(x 0\.325 to 0\.575 m, y -0\.125 to 0\.125 m\)"),
        ("cup", {"y_m": -0.5}, "cup shows no surface"),
        ("cup", {"size_m": 0.002}, "cup shows no surface.*misses every cell"),
        ("cup", {"front_m": 0.5}, "front_m of 0.5 m leaves the box"),
    ],
)
def test_an_object_that_cannot_be_is_a_scene_error(name: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        hidden_depth(name, RIG, options)


def test_a_plate_seen_edge_on_shows_nothing(tmp_path: Path) -> None:
    plate = tmp_path / "plate.obj"
    plate.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", encoding="utf-8")
    with pytest.raises(SceneError, match="seen edge on"):
        hidden_depth(str(plate), RIG, {"tilt_y_deg": 90})


def test_a_rig_without_a_box_hides_nothing(mesh: str) -> None:
    for name in ("cup", mesh):
        with pytest.raises(SceneError, match="no object_box"):
            hidden_depth(name, load_rig("bare-wall"), {})
