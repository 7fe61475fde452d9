"""`render`: an object to a file of maps, an account of effects, and no file overwritten."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from nlos_calibration.rig import dump_toml, load_rig

from nlos_cam.cli.main import main
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.effects import EFFECTS
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import HiddenObject, SceneFile
from nlos_cam.render.sensor.effects import sensor_effects
from nlos_cam.render.sensor.model import SensorModel

RIG = load_rig("paper-rig")
NAMES = [*EFFECTS, *(effect.name for effect in sensor_effects(SensorModel()))]


def _depth() -> np.ndarray:
    assert RIG.object_box is not None
    return object_depth(2, RIG.object_box)[1]


def _last(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_category_becomes_maps_a_picture_and_an_account(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cup.npz"
    assert main(["render", "cup", "--accuracy", "draft", "--out", str(out), "--explain", "--json"]) == 0
    shown = capsys.readouterr()
    result = json.loads(shown.out.splitlines()[-1])
    assert (result["accuracy"], result["out"]) == ("draft", str(out))
    assert result["seconds"] > 0
    assert [effect["name"] for effect in result["effects"]] == NAMES
    assert all(set(e) == {"name", "included", "reason", "bound", "seconds"} for e in result["effects"])
    assert "self-occlusion" in shown.err
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    with np.load(out) as file:
        assert {name: file[name].shape for name in ("depth_m", "intensity", "margin", "object_depth_m")} == {
            "depth_m": (64, 80),
            "intensity": (64, 80),
            "margin": (64, 80),
            "object_depth_m": (64, 64),
        }
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)


def test_a_depth_map_from_a_file_is_rendered_as_the_library_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "thing.npy", _depth())
    out = tmp_path / "maps.npz"
    assert main(["render", str(tmp_path / "thing.npy"), "--accuracy", "draft", "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out
    expected = render(Scene(RIG, _depth()), "draft")
    with np.load(out) as file:
        np.testing.assert_array_equal(file["depth_m"], expected.depth_m)
        np.testing.assert_array_equal(file["intensity"], expected.intensity)
        np.testing.assert_array_equal(file["object_depth_m"], _depth())


PLACED = {
    "size_m": 0.15,
    "tilt_x_deg": -10.0,
    "tilt_y_deg": 200.0,
    "turn_deg": 30.0,
    "x_m": -0.01,
    "y_m": 0.02,
    "front_m": 0.05,
}


@pytest.mark.parametrize("kind", ["category", "file"])
def test_a_placed_object_is_what_a_scene_file_says_of_it(tmp_path: Path, kind: str) -> None:
    """Every option is given, and each arrives."""
    thing, out = tmp_path / "thing.ply", tmp_path / "maps.npz"
    trimesh.creation.box(extents=(30, 20, 10)).export(thing)
    of_kind = {"category": ("hat", {"seed": 4}), "file": (str(thing), {"up": "z"})}
    name, only = of_kind[kind]
    fields = PLACED | only
    options = [text for field, value in fields.items() for text in (f"--{field.replace('_', '-')}", str(value))]
    assert main(["render", name, *options, "--accuracy", "draft", "--out", str(out)]) == 0
    hidden = HiddenObject.model_validate({kind: name, **fields})
    with np.load(out) as file:
        expected = SceneFile(name="same", rig=RIG, hidden=hidden).scene_at(0).object_depth_m
        np.testing.assert_array_equal(file["object_depth_m"], expected)


def test_what_is_there_is_overwritten_only_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cup.npz"
    out.write_bytes(b"precious")
    arguments = ["render", "cup", "--accuracy", "draft", "--out", str(out), "--json"]
    assert main(arguments) == 1
    assert _last(capsys)["error"]["type"] == "OutputExistsError"
    assert out.read_bytes() == b"precious"
    assert main([*arguments, "--overwrite"]) == 0
    assert out.read_bytes() != b"precious"


def test_what_it_says_it_wrote_is_there_whatever_the_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "cup", "--accuracy", "draft", "--out", str(tmp_path / "maps"), "--json"]) == 0
    assert Path(_last(capsys)["out"]).is_file()


def test_a_scene_lends_its_rig(tmp_path: Path) -> None:
    scene, out = tmp_path / "scene.toml", tmp_path / "maps.npz"
    lent = SceneFile(name="a scene", rig=RIG.model_copy(update={"name": "lent"}))
    scene.write_text(dump_toml(lent), encoding="utf-8")
    assert main(["render", "hat", "--scene", str(scene), "--accuracy", "draft", "--out", str(out)]) == 0
    with np.load(out) as file:
        assert str(file["rig_name"]) == "lent"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["teapot"], 1, "no object 'teapot'"),
        (["cup", "--accuracy", "perfect"], 1, "no accuracy 'perfect'"),
        (["cup", "--rig", "no-rig"], 4, "no-rig"),
        (["cup", "--rig", "bare-wall"], 1, "no object_box"),
        (["cup", "--scene", "none.toml"], 1, "none.toml"),
        (["none.npy"], 1, "none.npy"),
        ([], 2, ""),
        (["cup", "--seed", "-1"], 2, "seed"),
        (["cup", "--size-m", "nan"], 2, "size_m: must be from 0.001 to 10 (got nan)"),
        (["cup", "--size-m", "-1"], 2, "size_m"),
        (["cup", "--up", "z"], 2, "leave out --up"),
        (["cup", "--up", "w"], 2, "'y', 'z'"),
        (["none.stl", "--seed", "1"], 2, "leave out --seed"),
        (["none.npy", "--turn-deg", "1"], 2, "leave out --turn-deg"),
        (["none.stl"], 1, "none.stl cannot be read"),
        (["none.glb"], 1, "no object 'none.glb'"),
        (["cup", "--x-m", "1"], 1, "cup shows no surface in the object box"),
    ],
)
def test_what_cannot_be_has_its_code_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    assert main(["render", *arguments, "--out", str(tmp_path / "maps.npz")]) == code
    shown = capsys.readouterr()
    assert words in shown.err
    assert not shown.err or shown.err.count("\n") == 1
    assert "Traceback" not in shown.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("harm", ["empty", "text", "truncated", "flat", "words"])
def test_a_file_that_is_no_depth_map_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], harm: str) -> None:
    path = tmp_path / "thing.npy"
    np.save(path, {"flat": np.zeros(64), "words": np.array(["a", "b"])}.get(harm, _depth()))
    if harm in {"empty", "text", "truncated"}:
        whole = path.read_bytes()
        path.write_bytes({"empty": b"", "text": b"hello", "truncated": whole[:1000]}[harm])
    assert main(["render", str(path), "--out", str(tmp_path / "maps.npz"), "--json"]) == 1
    assert _last(capsys)["error"]["type"] == "SceneError"
    assert not (tmp_path / "maps.npz").exists()
