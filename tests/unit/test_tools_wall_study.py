"""A small version of the study of the wall fit, and of the scenes that it looks at."""

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

TOOLS = Path(__file__).parents[2] / "tools"
PINHOLE = load_rig("bare-wall").pinhole.scaled(80, 60)


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("wall_study")


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("wall_scenes")


def test_some_dozens_of_walls_are_measured_and_told(
    study: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = [one for one in study.settings() if one.frames == 8 and one.noise == 1.0 and one.scene != "sensor"]
    monkeypatch.setattr(study, "settings", lambda: few)
    monkeypatch.setattr(study, "DOCS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["wall_study.py", "--runs", "3"])
    (tmp_path / "images").mkdir()
    study.main()
    table = json.loads((tmp_path / "wall_study.json").read_text(encoding="utf-8"))
    bare = table["all"][0]
    assert bare["runs"] >= 12
    assert bare["distance_mm"]["p95"] < 1.0
    assert bare["facing_deg"]["p95"] < 0.2
    assert bare["refused"] < 0.2
    assert sum(one["wrong_and_good"] for rows in table.values() if isinstance(rows, list) for one in rows) == 0
    assert {one["name"] for one in table["hard"]} == set(study.HARD)
    assert (tmp_path / "images" / "wall_study.png").stat().st_size > 10_000
    assert "| corner | 6 |" in capsys.readouterr().out


def test_the_same_trial_has_the_same_outcome(study: ModuleType) -> None:
    setting = study.Setting("bent", frames=1)
    first, second = (study.study([setting], 2)[setting] for _ in range(2))
    assert repr(first) == repr(second)
    assert first[0] != first[1]


def test_a_wrong_plane_is_counted(study: ModuleType) -> None:
    outcome = study.Outcome((0.2, 45.0), verdict="good", distance_error_m=0.0011, turn_deg=0.0)
    row = study.row("lie", [outcome, study.Outcome((0.2, 45.0), refused="no wall")])
    assert (row["wrong"], row["wrong_and_good"], row["refused"]) == (1, 1, 0.5)


def test_the_simulated_cameras_sensor_is_looked_at_too(study: ModuleType) -> None:
    setting = study.Setting("sensor", frames=2)
    (outcome,) = study.study([setting], 1)[setting]
    assert outcome.verdict == "good"
    assert abs(outcome.distance_error_m) < 1e-4


@pytest.mark.parametrize("bend_deg", [-20.0, -1.0, 1.0, 20.0])
@pytest.mark.parametrize("direction_rad", [0.0, 1.0, 2.5])
def test_a_bent_wall_is_one_plane_on_either_side_of_a_fold_without_a_gap(
    scenes: ModuleType, bend_deg: float, direction_rad: float
) -> None:
    seen = scenes.view(0.2, 20.0, 5.0, PINHOLE)
    depth_m, main = scenes.bent(seen, bend_deg, 0.4, direction_rad)
    _, other = scenes.bent(seen, bend_deg, 0.6, direction_rad)
    assert main is seen
    assert np.degrees(np.arccos(other.pose[2, :3] @ seen.pose[2, :3])) == pytest.approx(abs(bend_deg))
    first = depth_m == seen.depth_m
    assert first.mean() == pytest.approx(0.6, abs=0.03)
    fold = first[:, 1:] != first[:, :-1]
    assert fold.any()
    assert np.abs(np.diff(depth_m, axis=1))[fold].max() < 0.01


def test_scenes_are_off_the_wall_by_what_they_say(scenes: ModuleType) -> None:
    seen = scenes.view(0.2, 30.0, 0.0, PINHOLE)
    away = -(PINHOLE.rays() @ seen.pose[2, :3])

    def height_m(depth_m: np.ndarray) -> np.ndarray:
        return 0.2 - depth_m * away

    assert np.allclose(np.unique(height_m(scenes.stepped(seen, 0.004, 0.3)).round(9)), [0.0, 0.004])
    assert np.allclose(np.unique(height_m(scenes.window(seen, 0.01)).round(9)), [-0.01, 0.0])
    assert (height_m(scenes.window(seen, 0.01)) < -0.005).mean() == pytest.approx(0.5, abs=0.1)
    assert np.abs(height_m(scenes.curved(seen, 1.0))).max() > 0.002
    assert scenes.patch(seen, 0.25).mean() == pytest.approx(0.25, abs=0.03)
    ripples_m = scenes.rippled(seen, 0.001, 4.0, np.random.default_rng(0)) - seen.depth_m
    assert np.abs(ripples_m).max() == pytest.approx(0.001, rel=0.01)
