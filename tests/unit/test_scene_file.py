"""Scenes as TOML: round trips, motion that closes its loop, errors that name the field."""

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from nlos_calibration.rig import dump_toml, load_rig
from pydantic import ValidationError

from nlos_cam.errors import SceneError
from nlos_cam.render.scene_file import Fault, HiddenObject, Motion, SceneFile, bare_wall_scene, load_scene, paper_scene
from nlos_cam.render.sensor.model import SensorModel

CUP = """
name = "cup"
rig = "paper-rig"

[object]
category = "cup"
seed = 3
size_m = 0.15

[motion]
poses = 8
sway_x_m = 0.03
turn_deg = 20.0
"""


def _load(folder: Path, text: str) -> SceneFile:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return load_scene(path)


def test_a_file_says_object_and_the_rigs_name(tmp_path: Path) -> None:
    scene = _load(tmp_path, CUP)
    assert scene.hidden == HiddenObject(category="cup", seed=3, size_m=0.15)
    assert scene.rig == load_rig("paper-rig")
    assert scene.poses == 8
    assert scene.sensor == SensorModel()


def test_a_rig_may_be_a_path(tmp_path: Path) -> None:
    rig = load_rig("paper-rig").model_copy(update={"name": "mine"})
    (tmp_path / "wall.toml").write_text(dump_toml(rig), encoding="utf-8")
    assert _load(tmp_path, CUP.replace("paper-rig", str(tmp_path / "wall.toml"))).rig == rig


@pytest.mark.parametrize("make", [paper_scene, bare_wall_scene], ids=["paper", "bare wall"])
@pytest.mark.parametrize("by_alias", [True, False])
def test_a_scene_survives_a_file(tmp_path: Path, make: Callable[[], SceneFile], by_alias: bool) -> None:
    scene = make()
    text = tomli_w.dumps(scene.model_dump(mode="json", by_alias=by_alias, exclude_none=True))
    assert ("object" in tomllib.loads(text)) == (by_alias and scene.hidden is not None)
    again = _load(tmp_path, text)
    assert again == scene
    assert again.checksum == scene.checksum


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("size_m = 0.15", "size_m = -1.0", r"object\.size_m"),
        ("size_m = 0.15", 'size_m = "big"', r"object\.size_m"),
        ("seed = 3", "seed = -3", r"object\.seed"),
        ("seed = 3", "sede = 3", r"object\.sede"),
        ("poses = 8", "poses = 0", r"motion\.poses"),
        ('rig = "paper-rig"', 'rig = "none"', "rig"),
        ('rig = "paper-rig"', "", "rig"),
        ('name = "cup"', "", "name"),
        ("turn_deg = 20.0", "spin = 1", r"motion\.spin"),
        ('category = "cup"', 'category = "teapot"', r"category.*teapot"),
        ('category = "cup"', "", r"object: give one of category and file"),
        ('category = "cup"', 'category = "cup"\nup = "z"', r"object: up is for a file"),
        ('category = "cup"', 'file = "none.stl"', r"object\.file: .*none\.stl cannot be read.*No such file"),
        ('category = "cup"', 'file = "map.npy"', r"object\.file: .*map\.npy is no mesh"),
        ('category = "cup"', "file = 3", r"object\.file: must be the path of a mesh \(got 3\)"),
        ("size_m = 0.15", "size_m = nan", r"object\.size_m: must be from 0\.001 to 10 \(got nan\)"),
        ("size_m = 0.15", "tilt_x_deg = inf", r"object\.tilt_x_deg: must be from -360 to 360 \(got inf\)"),
        ("size_m = 0.15", "tilt_y_deg = 361", r"object\.tilt_y_deg: must be from -360 to 360 \(got 361\)"),
        ("size_m = 0.15", "turn_deg = nan", r"object\.turn_deg"),
        ("size_m = 0.15", "x_m = -inf", r"object\.x_m: must be from -10 to 10 \(got -inf\)"),
        ("size_m = 0.15", "y_m = nan", r"object\.y_m"),
        ("size_m = 0.15", "front_m = -0.01", r"object\.front_m: must be from 0 to 10 \(got -0\.01\)"),
        ("sway_x_m = 0.03", "sway_x_m = nan", r"motion\.sway_x_m: must be from -10 to 10 \(got nan\)"),
        ("sway_x_m = 0.03", "sway_y_m = inf", r"motion\.sway_y_m"),
        ("sway_x_m = 0.03", "approach_m = -1", r"motion\.approach_m: must be from 0 to 10"),
        ("sway_x_m = 0.03", "tilt_deg = nan", r"motion\.tilt_deg"),
        ("turn_deg = 20.0", "turn_deg = nan", r"motion\.turn_deg"),
        ("size_m = 0.15", "front_m = 0.4", r"front_m of 0\.4 m leaves the box"),
        ("size_m = 0.15", "x_m = 0.5", r"cup shows no surface in the object box.*x_m"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(SceneError, match=named) as caught:
        _load(tmp_path, CUP.replace(old, new))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"name = ", b"\xff\xfe\x00", b""])
def test_what_is_no_scene_is_a_scene_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "scene.toml").write_bytes(content)
    with pytest.raises(SceneError, match=r"scene\.toml"):
        load_scene(tmp_path / "scene.toml")


def test_a_missing_file_is_a_scene_error(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"none\.toml cannot be read"):
        load_scene(tmp_path / "none.toml")


def test_the_checksum_ignores_the_name_and_the_sensor_and_nothing_else() -> None:
    scene = paper_scene()
    same = scene.model_copy(update={"name": "other", "sensor": SensorModel(shot_noise=0)})
    assert same.checksum == scene.checksum
    assert scene.hidden is not None
    others = [
        scene.model_copy(update={"motion": Motion(poses=91)}),
        scene.model_copy(update={"hidden": scene.hidden.model_copy(update={"x_m": 0.001})}),
        scene.model_copy(update={"rig": load_rig("bare-wall")}),
    ]
    assert len({scene.checksum, *(other.checksum for other in others)}) == 4


def test_the_pulse_is_the_renderers_and_changes_the_checksum_and_the_scene() -> None:
    plain = paper_scene()
    wide = plain.model_copy(update={"sensor": SensorModel(pulse_ns=1.0)})
    assert wide.checksum != plain.checksum
    assert (wide.scene_at(0).pulse_ns, plain.scene_at(0).pulse_ns) == (1.0, 0.0)


def test_material_and_radiometry_reach_the_scene(tmp_path: Path) -> None:
    text = CUP.replace("[object]", 'radiometry = "lambertian"\njump_m = 0.05\n[object]')
    text = text.replace("[motion]", '[object.material]\nkind = "phong"\nalbedo = 0.5\n[motion]')
    scene, plain = _load(tmp_path, text), _load(tmp_path, CUP)
    at = scene.scene_at(0)
    assert (at.radiometry, at.jump_m, float(np.asarray(at.surface.albedo))) == ("lambertian", 0.05, 0.5)
    assert at.surface.brdf is not None
    assert scene.checksum != plain.checksum
    assert plain.scene_at(0).surface.brdf is None


def test_between_two_frames_it_stands_between() -> None:
    scene = paper_scene()
    assert scene.hidden is not None
    poses = [scene.pose_at(scene.hidden, number) for number in (3, 3.5, 4)]
    assert poses[0].x_m < poses[1].x_m < poses[2].x_m


def test_the_default_object_is_one_that_no_training_reaches() -> None:
    scene = paper_scene()
    assert scene.hidden is not None
    assert scene.hidden.seed >= 20_000_000


def test_a_loop_closes_and_moves(tmp_path: Path) -> None:
    scene = _load(tmp_path, CUP)
    depths = [scene.scene_at(k).object_depth_m for k in range(9)]
    np.testing.assert_array_equal(depths[0], depths[8])
    assert not np.array_equal(depths[0], depths[2], equal_nan=True)
    np.testing.assert_array_equal(scene.scene_at(2).object_depth_m, depths[2])


def test_the_whole_loop_of_the_default_scene_stays_in_its_box() -> None:
    scene = paper_scene()
    assert scene.rig.object_box is not None
    edges = [
        np.isfinite(np.concatenate([d[0], d[-1], d[:, 0], d[:, -1]])).any()
        for k in range(0, scene.poses, 3)
        if (d := scene.scene_at(k).object_depth_m) is not None
    ]
    assert len(edges) == 30
    assert not any(edges)


def test_without_an_object_there_is_one_bare_instant() -> None:
    scene = bare_wall_scene()
    assert scene.poses == 1
    assert scene.scene_at(5).object_depth_m is None
    still = scene.model_copy(update={"motion": Motion(poses=90)})
    assert still.poses == 1


def test_an_object_without_a_box_is_refused_with_its_name() -> None:
    scene = SceneFile(name="wrong", rig=load_rig("bare-wall"), hidden=HiddenObject(category="cup"))
    with pytest.raises(SceneError, match=r"'bare-wall' has no object_box.*'cup'"):
        scene.scene_at(0)


def test_a_scene_is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        paper_scene().name = "other"  # type: ignore[misc]


def test_a_rigs_path_starts_from_the_scenes_own_folder(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(dump_toml(load_rig("paper-rig").model_copy(update={"name": "bench"})))
    (tmp_path / "scene.toml").write_text('name = "mine"\nrig = "bench.toml"\n')
    assert load_scene(tmp_path / "scene.toml").rig.name == "bench"


def test_an_object_that_only_part_of_its_loop_shows_is_a_scene(tmp_path: Path) -> None:
    scene = _load(tmp_path, CUP.replace("size_m = 0.15", "x_m = 0.25").replace("sway_x_m = 0.03", "sway_x_m = 0.2"))
    assert [scene.shows_at(0), scene.shows_at(6)] == [False, True]


def test_faults_are_read_and_change_nothing_that_is_rendered(tmp_path: Path) -> None:
    scene = _load(tmp_path, CUP)
    faulty = _load(tmp_path, CUP + '[[faults]]\nkind = "stall"\nat_frame = 30\nframes = 9\n')
    assert (scene.faults, faulty.faults) == ((), (Fault(kind="stall", at_frame=30, frames=9),))
    assert faulty.checksum == scene.checksum


@pytest.mark.parametrize("fault", ['kind = "explode"', 'kind = "stall"\nframes = -2', 'kind = "stall"\nwhen = 3'])
def test_a_fault_that_cannot_be_is_told_in_one_line(tmp_path: Path, fault: str) -> None:
    with pytest.raises(SceneError, match=r"scene\.toml is not a scene: faults\.0\.") as told:
        _load(tmp_path, f"{CUP}[[faults]]\nat_frame = 1\n{fault}\n")
    assert "\n" not in str(told.value)
