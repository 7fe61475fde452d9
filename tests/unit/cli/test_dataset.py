"""`dataset build` turns options into a plan and shards; `dataset label` turns labelled recordings
into a dataset.
"""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import trimesh
from fake_workers import FakeWorkers
from nlos_calibration import load_rig
from nlos_models import SIMULATION_ONLY
from rich.progress import Progress

from nlos_cam.cli.dataset import Rate
from nlos_cam.dataset import DatasetPlan, RigSpread, build, open_dataset, read_head
from nlos_cam.dataset.samples import hidden_object
from nlos_cam.objects import CATEGORIES, TEXTURES, object_box
from nlos_cam.recording import ReplayCamera, SidecarFile, sidecar_path

Run = Callable[..., Any]


@pytest.fixture(autouse=True)
def _no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    def processes(workers: int) -> FakeWorkers:
        assert workers > 0
        return FakeWorkers()

    monkeypatch.setattr(build, "processes", processes)


@pytest.fixture
def built(run: Run) -> Run:
    """Build a dataset; returns what is printed, without the times."""

    def call(folder: Path, *options: object, code: int = 0) -> dict[str, Any]:
        result = run("dataset", "build", "--out", folder, "--count", "4", *options, code=code)
        if made := result.get("made"):
            assert result.pop("objects_per_s") == pytest.approx(made / result.pop("seconds"))
        return result

    return call


def _command(folder: Path) -> str:
    with h5py.File(open_dataset(folder, expected=True).shards[0].path) as file:
        return str(file.attrs["command"])


def test_build_reports_and_resumes(tmp_path: Path, built: Run) -> None:
    assert built(tmp_path) == {"objects": 4, "made": 4, "damaged": [], "out": str(tmp_path)}
    assert built(tmp_path, "--count", "6")["made"] == 6  # a shard that was not full is made again

    result = built(tmp_path, "--count", "6")

    assert (result["made"], result["objects_per_s"]) == (0, None)
    assert open_dataset(tmp_path).plan == DatasetPlan(load_rig("paper-rig"), 0)


def test_build_options_set_plan_and_are_stored_as_command(tmp_path: Path, built: Run) -> None:
    spread = ["--rig-spread-mm", "10", "--rig-spread-deg", "3", "--gain-spread-percent", "20"]
    others = [
        "--without",
        "hat, boat",
        "--backgrounds",
        "0.25",
        "--accuracy",
        "draft",
        "--seed",
        "7",
    ]
    spread.append("--off-record")
    built(folder := tmp_path / "a b", *spread, *others, "--expected-maps", "--workers", "1")
    plan = open_dataset(folder, expected=True).plan

    assert plan.spread == RigSpread(place_m=0.01, angle_deg=3, gain_share=0.2)
    assert plan.off_record
    assert set(CATEGORIES) - set(plan.objects.categories) == {"hat", "boat"}
    assert (plan.objects.backgrounds, plan.accuracy, plan.first_seed, plan.expected) == (
        0.25,
        "draft",
        7,
        True,
    )
    assert _command(folder).startswith(
        f"nlos-cam dataset build --out '{folder}' --count 4 --seed 7 "
    )
    assert " --without 'hat, boat' " in _command(folder)
    assert _command(folder).endswith(" --workers 1 --backend cpu")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--rig-spread-mm", "inf"),
        ("--rig-spread-deg", "inf"),
        ("--gain-spread-percent", "inf"),
        ("--up", "z"),
    ],
)
def test_build_refuses_endless_spreads_and_an_axis_of_no_mesh(
    tmp_path: Path, run: Run, option: str, value: str
) -> None:
    refused = run("dataset", "build", "--out", tmp_path / "d", "--count", 1, option, value, code=2)

    assert option in refused.err


def test_build_turns_the_meshes_of_a_folder_upright(tmp_path: Path, built: Run) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.cone(0.3, 1.0).export(meshes / "cone.stl")
    built(tmp_path / "d", "--objects", str(meshes), "--up", "z")
    lying = open_dataset(tmp_path / "d").plan.objects
    standing = replace(lying, up="y")
    (_, one), (_, other) = (
        hidden_object(replace(each, folder=meshes), 3, object_box(load_rig("paper-rig")))
        for each in (lying, standing)
    )

    assert lying.up == "z"
    assert not np.array_equal(one, other, equal_nan=True)


def test_build_interrupted_at_transients_says_what_it_kept(
    tmp_path: Path, built: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("nlos_cam.dataset.build_transients", interrupted)
    result = built(tmp_path, "--transient", code=130)

    assert "finished shards and transients are kept" in result.err
    assert "nothing was written" not in result.err


def test_build_in_color_is_noted_as_simulation_only(tmp_path: Path, built: Run) -> None:
    assert built(tmp_path, "--colour")["note"] == SIMULATION_ONLY
    assert open_dataset(tmp_path, color=True).plan.textures == tuple(TEXTURES)
    assert "textures" in built(tmp_path, code=4)["error"]["message"]


def test_build_takes_rig_and_sensor_of_scene(tmp_path: Path, built: Run) -> None:
    scene = tmp_path / "scene.toml"
    text = 'name = "s"\nrig = "paper-rig"\n[sensor]\nambient_counts = 20.0\n'
    scene.write_text(text, encoding="utf-8")

    built(tmp_path / "d", "--scene", scene)

    assert open_dataset(tmp_path / "d").plan.sensor.ambient_counts == 20


def test_build_hides_meshes_of_folder(tmp_path: Path, built: Run) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")

    built(tmp_path / "d", "--objects", tmp_path)

    plan = open_dataset(tmp_path / "d").plan

    assert [name for name, _ in plan.objects.meshes] == ["cube.stl"]


def test_build_reports_damaged_shard(tmp_path: Path, built: Run, shown: Run) -> None:
    built(tmp_path)
    (shard := tmp_path / "shard-000000000.h5").write_bytes(b"")
    printed = shown("dataset", "build", "--out", tmp_path, "--count", "4", "--json")

    assert shard.name in printed.err
    assert json.loads(printed.out)["damaged"] == [str(shard)]
    assert len(read_head(shard).seeds) == 4


def test_build_without_ray_names_the_extra(
    tmp_path: Path, built: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "nlos-cam[many]" in built(tmp_path / "d", "--ray", "auto", code=1)["error"]["message"]


def test_ray_and_a_backend_contradict(shown: Run, tmp_path: Path) -> None:
    words = "--ray", "auto", "--backend", "torch"

    err = shown("dataset", "build", "--count", 1, "--out", tmp_path / "d", *words, code=2).err

    assert "--backend torch" in " ".join(err.split())


@pytest.mark.parametrize("other", [("--ray", "auto"), ("--backend", "torch")])
def test_workers_beside_another_farm_are_refused(
    shown: Run, tmp_path: Path, other: tuple[str, str]
) -> None:
    build = "dataset", "build", "--count", 1, "--out", tmp_path / "d"
    adapt = "adapt", "paper-rig", "--out", tmp_path / "a"

    for command in (build, adapt):
        assert "--workers" in shown(*command, *other, "--workers", 2, code=2).err


def test_rate_is_objects_per_second_once_known() -> None:
    clock = iter(range(100))
    bar = Progress(get_time=lambda: float(next(clock)))
    task = bar.add_task("x", total=100)

    assert Rate().render(bar.tasks[0]).plain == ""

    for done in (1, 2, 3):
        bar.update(task, completed=done)

    assert Rate().render(bar.tasks[0]).plain.endswith("/s")


@pytest.fixture
def recordings(noise_bag: Path, tmp_path: Path) -> Path:
    """Two recordings with a depth map for each: one named after its label, one after its
    recording.
    """
    (folder := tmp_path / "recordings").mkdir()
    for name, label, truth, depth_m in (("a", "mug", "mug", 0.2), ("b", "jug", "b", 0.3)):
        shutil.copy(noise_bag, bag := folder / f"{name}.bag")
        SidecarFile(sidecar_path(bag), ReplayCamera(bag), label=label)
        np.save(folder / f"{truth}.npy", np.full((64, 64), depth_m, np.float32))
    return folder


@pytest.fixture
def label(recordings: Path, tmp_path: Path, run: Run) -> Run:
    return partial(run, "dataset", "label", recordings, "--out", tmp_path / "my data")


def test_label_makes_dataset_of_single_frames(label: Run, tmp_path: Path) -> None:
    result = label("--frames", "3")
    maps = (data := open_dataset(out := tmp_path / "my data")).arrays()
    plan = data.plan

    assert len(maps.image) == result["samples"] == 6
    assert result["recordings"] == 2
    assert result["labels"] == ["jug", "mug"]
    assert result["out"] == str(out)
    assert result["rig_name"] == plan.rig.name
    assert result["rig_checksum"] == plan.rig.checksum
    assert [len(np.unique(image)) for image in maps.image] == [1] * 6
    assert maps.image[0, 0, 0] > maps.image[5, 0, 0]


def test_label_replaces_dataset_only_with_overwrite(
    label: Run, recordings: Path, tmp_path: Path
) -> None:
    out = tmp_path / "my data"
    label("--frames", "2")

    assert label("--frames", "1", code=1)["error"]["type"] == "OutputExistsError"
    assert len(open_dataset(out).arrays().image) == 4

    label("--frames", "1", "--overwrite")

    assert len(open_dataset(out).arrays().image) == 2
    assert (
        _command(out) == f"nlos-cam dataset label {recordings} --out '{out}' --frames 1 --overwrite"
    )

    (recordings / "b.npy").unlink()
    error = label("--overwrite", code=4)["error"]

    assert (error["type"], "'jug'" in error["message"]) == ("RecordingError", True)
    assert len(open_dataset(out).arrays().image) == 2
