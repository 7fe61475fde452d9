import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import trimesh
from nlos_calibration.rig import dump_toml, load_rig
from pydantic import ValidationError

from nlos_cam.errors import SceneError
from nlos_cam.objects.meshes import read_mesh
from nlos_cam.render import (
    Fault,
    HiddenObject,
    SceneFile,
    SensorModel,
    bare_wall_scene,
    load_scene,
    paper_scene,
)
from nlos_cam.render.scene_file import Motion, one_wrap, packaged_scenes

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


def test_load_scene_reads_object_rig_and_faults(tmp_path: Path) -> None:
    scene = _load(tmp_path, CUP)

    assert scene.hidden == HiddenObject(category="cup", seed=3, size_m=0.15)
    assert scene.rig == load_rig("paper-rig")
    assert scene.poses == 8
    assert scene.sensor == SensorModel()

    faulty = _load(tmp_path, CUP + '[[faults]]\nkind = "stall"\nat_frame = 30\nframes = 9\n')

    assert scene.faults == ()
    assert faulty.faults == (Fault(kind="stall", at_frame=30, frames=9),)
    assert faulty.checksum == scene.checksum


@pytest.mark.parametrize(
    "make",
    [paper_scene, bare_wall_scene],
    ids=["paper", "bare wall"],
)
@pytest.mark.parametrize("by_alias", [True, False])
def test_scene_survives_a_file(
    tmp_path: Path, make: Callable[[], SceneFile], by_alias: bool
) -> None:
    scene = make()
    text = tomli_w.dumps(
        scene.model_dump(
            mode="json",
            by_alias=by_alias,
            exclude_none=True,
        )
    )

    assert ("object" in tomllib.loads(text)) == (by_alias and scene.hidden is not None)

    again = _load(tmp_path, text)

    assert again == scene
    assert again.checksum == scene.checksum


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("size_m = 0.15", "size_m = nan", r"object\.size_m.*nan"),
        ("size_m = 0.15", "tilt_x_deg = inf", r"object\.tilt_x_deg.*inf"),
        ("size_m = 0.15", "x_m = -inf", r"object\.x_m.*-inf"),
        ("size_m = 0.15", "front_m = -0.01", r"object\.front_m.*-0\.01"),
        ("size_m = 0.15", "front_m = 0.4", r"front_m.*0\.4 m"),
        ("size_m = 0.15", "x_m = 0.5", "cup.*x_m"),
        ("seed = 3", "sede = 3", r"object\.sede"),
        ('rig = "paper-rig"', 'rig = "none"', "rig"),
        ('rig = "paper-rig"', "", "rig"),
        ('name = "cup"', "", "name"),
        ('category = "cup"', 'category = "teapot"', "category.*teapot"),
        ('category = "cup"', "", "object.*category"),
        ('category = "cup"', 'category = "cup"\nup = "z"', "object: up"),
        ('category = "cup"', 'file = "none.stl"', r"object\.file.*none\.stl.*No such file"),
        ('category = "cup"', 'file = "map.npy"', r"object\.file.*map\.npy"),
        ('category = "cup"', "file = 3", r"object\.file.*3"),
        *[
            ("sway_x_m = 0.03", f"{field} = {value}", rf"motion\.{field}")
            for field, value in (
                ("poses", 0),
                ("spin", 1),
                ("sway_x_m", "nan"),
                ("approach_m", -1),
            )
        ],
        ("[motion]", '[[faults]]\nat_frame = 1\nkind = "explode"\n[motion]', r"faults\.0\."),
        (CUP, "name = ", r"scene\.toml"),
        (CUP, "", r"scene\.toml"),
    ],
)
def test_load_scene_names_what_is_wrong(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(SceneError, match=named) as caught:
        _load(tmp_path, CUP.replace(old, new).replace("poses = 8\n", ""))
    assert "\n" not in str(caught.value)


def test_load_scene_names_a_missing_and_an_undecodable_file(tmp_path: Path) -> None:
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    for name in ("none.toml", "bytes.toml"):
        with pytest.raises(SceneError, match=name):
            load_scene(tmp_path / name)


def test_checksum_ignores_name_and_sensor_except_the_pulse() -> None:
    scene = paper_scene()
    same = scene.model_copy(
        update={
            "name": "other",
            "sensor": SensorModel(shot_noise=0),
        }
    )

    assert same.checksum == scene.checksum

    others = [
        scene.model_copy(update={"motion": Motion(poses=91)}),
        scene.model_copy(update={"hidden": scene.hidden.model_copy(update={"x_m": 0.001})}),
        scene.model_copy(update={"rig": load_rig("bare-wall")}),
        wide := scene.model_copy(update={"sensor": SensorModel(pulse_ns=1.0)}),
    ]

    assert len({scene.checksum, *(other.checksum for other in others)}) == 5
    assert wide.scene_at(0).pulse_ns == 1.0
    assert scene.scene_at(0).pulse_ns == 0.0


def test_material_and_radiometry_reach_the_scene(tmp_path: Path) -> None:
    text = CUP.replace("[object]", 'radiometry = "lambertian"\njump_m = 0.05\n[object]')
    text = text.replace("[motion]", '[object.material]\nkind = "phong"\nalbedo = 0.5\n[motion]')
    scene = _load(tmp_path, text)
    plain = _load(tmp_path, CUP)
    at = scene.scene_at(0)

    assert at.radiometry == "lambertian"
    assert at.jump_m == 0.05
    assert float(np.asarray(at.surface.albedo)) == 0.5
    assert at.surface.brdf is not None
    assert scene.checksum != plain.checksum
    assert plain.scene_at(0).surface.brdf is None


def test_paper_scene_moves_in_its_box_and_is_not_trained_on() -> None:
    scene = paper_scene()

    assert scene.hidden.seed >= 20_000_000

    poses = [scene.pose_at(scene.hidden, number) for number in (3, 3.5, 4)]

    assert poses[0].x_m < poses[1].x_m < poses[2].x_m

    for number in range(0, scene.poses, 3):
        depth = scene.scene_at(number).object_depth_m
        assert np.isnan(
            np.concatenate(
                [
                    depth[0],
                    depth[-1],
                    depth[:, 0],
                    depth[:, -1],
                ]
            )
        ).all()


def test_motion_is_a_closed_loop(tmp_path: Path) -> None:
    scene = _load(tmp_path, CUP)
    depths = [scene.scene_at(k).object_depth_m for k in range(9)]

    np.testing.assert_array_equal(depths[0], depths[8])
    assert not np.array_equal(depths[0], depths[2], equal_nan=True)
    np.testing.assert_array_equal(scene.scene_at(2).object_depth_m, depths[2])


def test_scene_has_one_pose_without_an_object_and_needs_a_box() -> None:
    scene = bare_wall_scene()

    assert scene.poses == 1
    assert scene.scene_at(5).object_depth_m is None

    still = scene.model_copy(update={"motion": Motion(poses=90)})

    assert still.poses == 1

    scene = SceneFile(
        name="wrong",
        rig=load_rig("bare-wall"),
        hidden=HiddenObject(category="cup"),
    )
    with pytest.raises(SceneError, match=r"object_box.*cup"):
        scene.scene_at(0)


def test_rig_path_is_absolute_or_relative_to_the_scene(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(
        dump_toml(load_rig("paper-rig").model_copy(update={"name": "bench"}))
    )
    for path in ("bench.toml", str(tmp_path / "bench.toml")):
        assert _load(tmp_path, f'name = "mine"\nrig = "{path}"\n').rig.name == "bench"


def test_scene_may_show_its_object_in_part_of_the_loop(tmp_path: Path) -> None:
    scene = _load(
        tmp_path,
        CUP.replace("size_m = 0.15", "x_m = 0.25").replace("sway_x_m = 0.03", "sway_x_m = 0.2"),
    )
    assert [scene.shows_at(0), scene.shows_at(6)] == [False, True]


WEDGE = CUP.replace('category = "cup"\nseed = 3', 'file = "things/wedge.stl"')


def _wedge(folder: Path, height: float = 0.6) -> Path:
    (folder / "things").mkdir(exist_ok=True)
    corners = [
        (0, 0, 0),
        (1, 0, 0),
        (0, height, 0),
        (0, 0, 0.4),
    ]
    solid = trimesh.Trimesh(
        corners,
        [
            (0, 2, 1),
            (0, 1, 3),
            (1, 2, 3),
            (0, 3, 2),
        ],
        process=False,
    )
    solid.export(folder / "things" / "wedge.stl")
    return folder / "things" / "wedge.stl"


def test_mesh_is_relative_to_its_scene_and_survives_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _wedge(tmp_path)
    monkeypatch.chdir(tmp_path.parent)
    scene = _load(tmp_path, WEDGE)

    assert scene.hidden.file == read_mesh(path)
    assert scene.shows_at(0)

    monkeypatch.chdir(tmp_path)
    scene = _load(Path(), WEDGE.replace("[motion]", 'up = "z"\n\n[motion]'))
    (tmp_path / "elsewhere").mkdir()
    again = _load(tmp_path / "elsewhere", dump_toml(scene))

    assert again == scene
    assert again.checksum == scene.checksum


def test_checksum_holds_a_mesh_as_loaded_not_its_path(
    tmp_path: Path,
) -> None:
    path = _wedge(tmp_path)
    scene = _load(tmp_path, WEDGE)
    first = scene.checksum
    depth = scene.scene_at(1).object_depth_m

    assert _load(tmp_path, WEDGE.replace('wedge.stl"', 'wedge.stl"\nup = "z"')).checksum != first
    assert _load(tmp_path, CUP).checksum != first

    path.rename(tmp_path / "moved.stl")

    assert _load(tmp_path, WEDGE.replace("things/wedge", "moved")).checksum == first

    for height in (0.61, 0.3):
        _wedge(tmp_path, height)
        assert _load(tmp_path, WEDGE).checksum != first
        # edited during rendering, it must not enter the cache under the checksum of the old one
        assert scene.checksum == first
        np.testing.assert_array_equal(scene.scene_at(1).object_depth_m, depth)


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"kind": "explode"}, "stall"),
        ({"stream": "depth"}, "stall"),
        ({"kind": "drops", "stream": "color"}, "infrared"),
        ({"kind": "clock_wrap", "frames": 2}, "clock_wrap"),
    ],
)
def test_fault_refuses_fields_that_make_no_sense(fields: dict[str, Any], word: str) -> None:
    with pytest.raises(ValidationError, match=word):
        Fault.model_validate({"kind": "stall", "at_frame": 0} | fields)
    wraps = tuple(
        Fault(
            kind="clock_wrap",
            at_frame=frame,
        )
        for frame in (1, 9)
    )

    assert one_wrap(wraps[:1]) == wraps[:1]

    with pytest.raises(ValidationError, match="clock_wrap"):
        SceneFile.model_validate({**dict(bare_wall_scene()), "faults": wraps})


@pytest.mark.parametrize(
    ("kind", "frames"),
    [
        ("stall", [5, 6, 7]),
        ("out_of_order", [5, 6, 7, 8, 9, 10]),
    ],
)
def test_fault_lasts_from_its_frame_on(kind: Any, frames: list[int]) -> None:
    fault = Fault(kind=kind, at_frame=5, frames=3)
    assert [frame for frame in range(20) if fault.befalls(frame)] == frames


def test_packaged_scenes_load_by_name() -> None:
    names = packaged_scenes()

    assert {"empty", "cup", "faults", "warming", "bench"} == names.keys()
    assert load_scene(Path("empty")) == load_scene(names["empty"])


def test_packaged_scene_loads_beside_a_folder_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("cup").mkdir()  # such as `replay --out cup` makes

    assert load_scene(Path("cup")).name == "cup"
