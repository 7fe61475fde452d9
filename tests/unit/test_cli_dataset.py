"""`dataset build`: options to a plan, a plan to shards, and what it says of them."""

import json
from pathlib import Path
from typing import Any

import pytest
from fake_farm import FakeFarm, samples_of
from nlos_calibration.rig import load_rig
from nlos_models.recipe import SIMULATION_ONLY
from rich.progress import Progress

from nlos_cam.cli.dataset import Rate
from nlos_cam.cli.main import main
from nlos_cam.dataset import build
from nlos_cam.dataset.shards import head_of
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.textures import TEXTURES

RIG = load_rig("paper-rig")


@pytest.fixture(autouse=True)
def farms(monkeypatch: pytest.MonkeyPatch) -> list[FakeFarm]:
    """The farms that took the place of processes."""
    made: list[FakeFarm] = []

    def processes(workers: int) -> FakeFarm:
        assert workers > 0
        made.append(FakeFarm())
        return made[-1]

    monkeypatch.setattr(build, "processes", processes)
    return made


def _build(folder: Path, *options: str) -> int:
    return main(["dataset", "build", "--out", str(folder), "--count", "4", *options, "--json"])


def _last(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def _plan(folder: Path) -> build.DatasetPlan:
    return build.open_dataset(folder).plan


def test_it_says_what_it_built_and_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _build(tmp_path) == 0
    told = _last(capsys)
    assert told["objects_per_s"] == pytest.approx(4 / told.pop("seconds"))
    del told["objects_per_s"]
    assert told == {"objects": 4, "made": 4, "damaged": [], "out": str(tmp_path)}
    assert _build(tmp_path, "--count", "6") == 0
    assert _last(capsys)["made"] == 6  # a shard that was not full is made anew
    assert _build(tmp_path, "--count", "6") == 0
    told = _last(capsys)
    assert (told["made"], told["objects_per_s"]) == (0, None)
    assert _plan(tmp_path) == build.DatasetPlan(RIG, 0)


def test_its_options_are_the_plans(tmp_path: Path) -> None:
    spread = ["--rig-spread-mm", "10", "--rig-spread-deg", "3", "--gain-spread-percent", "20"]
    others = ["--without", "hat, boat", "--backgrounds", "0.25", "--accuracy", "draft", "--seed", "7"]
    assert _build(tmp_path, *spread, *others) == 0
    plan = _plan(tmp_path)
    assert plan.spread == build.RigSpread(place_m=0.01, angle_deg=3, gain_share=0.2)
    assert set(CATEGORIES) - set(plan.objects.categories) == {"hat", "boat"}
    assert (plan.objects.backgrounds, plan.accuracy, plan.first_seed) == (0.25, "draft", 7)


def test_in_colour_it_says_that_it_is_a_simulation_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _build(tmp_path, "--colour") == 0
    assert _last(capsys)["note"] == SIMULATION_ONLY
    found = build.open_dataset(tmp_path, colour=True)
    assert found.plan.textures == tuple(TEXTURES)
    assert _build(tmp_path) == 4
    assert "another textures" in _last(capsys)["error"]["message"]


def test_a_shard_has_the_command_that_makes_it(tmp_path: Path) -> None:
    import h5py

    assert _build(tmp_path / "a b", "--without", "hat", "--workers", "1") == 0
    shard = build.open_dataset(tmp_path / "a b").shards[0]
    with h5py.File(shard.path) as file:
        command = str(file.attrs["command"])
    assert command.startswith(f"nlos-cam dataset build --out '{tmp_path}/a b' --count 4 --seed 0 ")
    assert " --without hat " in command
    assert command.endswith(" --workers 1")


def test_a_scene_gives_rig_and_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text('name = "s"\nrig = "paper-rig"\n[sensor]\nambient_counts = 20.0\n', encoding="utf-8")
    assert _build(tmp_path / "d", "--scene", str(scene)) == 0
    assert _plan(tmp_path / "d").sensor.ambient_counts == 20
    capsys.readouterr()
    assert _build(tmp_path / "d", "--scene", str(scene), "--rig", "paper-rig") == 2
    assert "has a rig of its own: leave out --rig" in capsys.readouterr().err


def test_another_rig_is_another_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _build(tmp_path) == 0
    assert _build(tmp_path, "--seed", "7") == 4
    assert _last(capsys)["error"]["type"] == "RecordingError"
    assert _build(tmp_path / "other", "--rig", "bare-wall") == 1
    assert "object_box" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_damage_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _build(tmp_path) == 0
    shard = tmp_path / "shard-000000000.h5"
    shard.write_bytes(b"")
    capsys.readouterr()
    assert _build(tmp_path) == 0
    captured = capsys.readouterr()
    assert "is damaged: it is made anew" in captured.err
    assert json.loads(captured.out)["damaged"] == [str(shard)]
    assert len(head_of(shard).seeds) == 4


def test_ctrl_c_keeps_finished_shards_and_is_130(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "SHARD", 2)
    monkeypatch.setattr(build, "processes", lambda _: FakeFarm(fails_after=1))
    assert _build(tmp_path) == 130
    assert "finished shards are kept" in capsys.readouterr().err
    assert build.read(tmp_path)[0].image.tolist() == samples_of(range(2))["image"].tolist()


def test_a_folder_of_meshes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import trimesh

    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    assert _build(tmp_path / "d", "--objects", str(tmp_path)) == 0
    assert [name for name, _ in _plan(tmp_path / "d").objects.meshes] == ["cube.stl"]
    assert _build(tmp_path / "e", "--objects", str(tmp_path / "none")) == 1
    assert _build(tmp_path / "e", "--objects", str(tmp_path), "--without", "hat") == 2
    assert "for procedural objects" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--count", "0"], 2),
        (["--count", "many"], 2),
        (["--backgrounds", "2"], 2),
        (["--without", "hut"], 1),
        (["--accuracy", "wrong"], 1),
        (["--rig-spread-mm", "500"], 1),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_made(tmp_path: Path, options: list[str], code: int) -> None:
    assert _build(tmp_path / "d", *options) == code
    assert not (tmp_path / "d").exists()


def test_without_ray_the_extra_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "ray", None)
    assert _build(tmp_path / "d", "--ray", "auto") == 1
    assert "pip install 'nlos-cam[many]'" in _last(capsys)["error"]["message"]


def test_the_rate_is_objects_per_second() -> None:
    clock = iter(range(100))
    bar = Progress(get_time=lambda: float(next(clock)))
    task = bar.add_task("x", total=100)
    assert Rate().render(bar.tasks[0]).plain == ""
    for done in (1, 2, 3):
        bar.update(task, completed=done)
    assert Rate().render(bar.tasks[0]).plain.endswith("/s")
