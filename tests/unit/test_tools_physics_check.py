"""The pure parts of the physics check's tools; the study on few objects, the latency on few frames."""

import importlib
import json
import os
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from fake_wall import WallCamera
from nlos_calibration.rig import ObjectBox

from nlos_cam.evaluate.subjects import SeededObject, seeded_objects
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor.model import SensorModel

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(autouse=True)
def _tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TOOLS)


@pytest.fixture
def study() -> ModuleType:
    return importlib.import_module("physics_check_study")


@pytest.fixture
def latency() -> ModuleType:
    return importlib.import_module("physics_check_latency")


def test_the_threshold_is_the_least_that_one_in_a_hundred_reaches(study: ModuleType) -> None:
    ordinary = np.arange(200) / 200
    threshold = study.least_threshold(ordinary)
    assert study.flagged(ordinary, threshold) <= 0.01 < study.flagged(ordinary, threshold - 0.01)
    assert study.least_threshold(np.full(5, 0.3)) == pytest.approx(0.31)


def test_how_well_scores_are_told_apart_is_a_probability(study: ModuleType) -> None:
    low, high = np.array([0.1, 0.2]), np.array([0.3, 0.4])
    assert (study.told_apart(low, high), study.told_apart(high, low), study.told_apart(low, low)) == (1.0, 0.0, 0.5)


def few(box: ObjectBox) -> list[SeededObject]:
    return seeded_objects(20_000_000, 3, box)


def test_a_small_study_tells_right_from_wrong(
    study: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def network(*_: np.ndarray) -> np.ndarray:
        return np.full((1, 64, 64), 0.5, np.float32)

    sight = SimpleNamespace(scene=Scene(study.RIG, few(study.BOX)[0].depth_m), sensor=SensorModel())
    monkeypatch.setattr(study, "test_set", few)
    monkeypatch.setattr(study, "load_reconstructor", lambda *_: network)
    monkeypatch.setattr(study, "outliers", lambda each: {"sheets": [sight] * each})
    monkeypatch.setattr(sys, "argv", ["study", "--new", "2", "--outside", "1", "--out", str(tmp_path)])
    study.main()
    table = json.loads((tmp_path / "physics_check.json").read_text())
    scores = table["scores"]
    assert {name: row["count"] for name, row in scores.items()} == {
        "the true object, draft": 3,
        "the true object, standard": 3,
        "test objects": 3,
        "new objects": 2,
        "another object's": 6,
        "empty bench, nothing shown": 3,
        "empty bench, an object shown": 3,
        "outside: sheets": 1,
    }
    assert scores["the true object, standard"]["most"] < 0.1
    assert scores["empty bench, nothing shown"]["most"] == 0.0
    assert scores["test objects"]["median"] > scores["the true object, draft"]["most"]
    assert table["outside"]["count"] == 1
    assert (tmp_path / "images" / "physics_check.png").read_bytes().startswith(b"\x89PNG")


class Camera(WallCamera):
    """Frames of the bare wall, as soon as they are asked for."""

    counts: Counter[str]


def test_the_loop_is_timed_each_way(latency: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "latency.json"
    monkeypatch.setattr(latency, "open_camera", lambda _: Camera(4))
    monkeypatch.setattr(latency, "load_reconstructor", lambda *_: lambda *_: np.full((1, 64, 64), 0.5, np.float32))
    monkeypatch.setattr(sys, "argv", ["latency", "--seconds", "9", "--rounds", "1", "--out", str(out)])
    latency.main()
    runs = json.loads(out.read_text())["runs"]
    assert [*runs] == ["none", "thread", "process"]
    assert all(0 < made["frames"] <= 4 for each in runs.values() for made in each)
    assert runs["none"][0]["checks"] == 0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc here")
def test_a_process_has_some_memory_and_no_process_none(latency: ModuleType) -> None:
    assert latency.memory_mib(os.getpid()) > 1
    assert latency.memory_mib(2**22 + 1) is None
