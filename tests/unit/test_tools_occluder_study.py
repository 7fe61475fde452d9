"""A small version of the study of the occluder's detection, and of the scenes that it looks at."""

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import LidarPose, Occluder, load_rig

from nlos_cam.render.geometry import cast

TOOLS = Path(__file__).parents[2] / "tools"
PAPER = load_rig("paper-rig")
PINHOLE = PAPER.pinhole.scaled(80, 60)


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("occluder_study")


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("occluder_scenes")


def view(distance_m: float, yaw_deg: float, pitch_deg: float, pinhole: Intrinsics) -> Any:
    return importlib.import_module("wall_scenes").view(distance_m, yaw_deg, pitch_deg, pinhole)


def test_some_dozens_of_benches_are_looked_at_and_told(
    study: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = study.settings()[::31]
    monkeypatch.setattr(study, "settings", lambda: few)
    monkeypatch.setattr(study, "DOCS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["occluder_study.py"])
    (tmp_path / "images").mkdir()
    study.main()
    table = json.loads((tmp_path / "occluder_study.json").read_text(encoding="utf-8"))
    in_view, _, edge_hidden, out_of_view = table["what there is to see"]
    assert sum(one["runs"] for one in table["what there is to see"]) == len(few)
    assert in_view["found"] > 0.8
    assert in_view["x_mm"]["p95"] < 0.5
    assert out_of_view["found"] == edge_hidden["found"] == 0.0
    assert any("no occluder is in view" in why for why in out_of_view["refused"])
    assert 10_000 < (tmp_path / "images" / "occluder_study.png").stat().st_size < 200_000
    assert f"| in view | {in_view['runs']} |" in capsys.readouterr().out


def test_the_same_trial_has_the_same_outcome(study: ModuleType) -> None:
    setting = study.Setting(frames=2)
    first, second = (study.trial(setting, np.random.default_rng(5)) for _ in range(2))
    assert repr(first) == repr(second)
    assert repr(first) != repr(study.trial(setting, np.random.default_rng(6)))


@pytest.mark.parametrize(("yaw_deg", "pitch_deg", "x_m", "gap_m"), [(45.0, 0.0, 0.2, 0.1), (60.0, -9.0, 0.15, 0.07)])
def test_the_scenes_rays_are_the_renderers(
    scenes: ModuleType, yaw_deg: float, pitch_deg: float, x_m: float, gap_m: float
) -> None:
    lidar = LidarPose(distance_m=0.2, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    rig = PAPER.model_copy(update={"lidar": lidar, "occluder": Occluder(x_m=x_m, z_min_m=gap_m)})
    beams = cast(rig, PINHOLE)
    seen = scenes.View(rig.wall_from_lidar, PINHOLE)
    depth_m = scenes.bench(seen, scenes.Sheet(x_m, gap_m)).ravel()
    met = np.isfinite(beams.length_m) & (beams.foot_m[:, 0] < 2.0) & (np.abs(beams.foot_m[:, 1]) < 1.5)
    np.testing.assert_allclose(depth_m[met], (beams.length_m * beams.cos_axis)[met], rtol=1e-9)
    assert (~beams.on_wall & met).any()


def test_a_badly_set_sheet_is_where_it_says(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    sheet = scenes.Sheet(lean_deg=10.0, twist_deg=-5.0, edge_deg=4.0, height_m=0.05, bottom_m=-0.03, top_m=0.04)
    depth_m, bare_m = scenes.bench(seen, sheet), scenes.bench(seen, None)
    on = depth_m < bare_m
    x, y, z = (seen.pose[:3, 3] + (PINHOLE.rays() * depth_m[..., np.newaxis])[on] @ seen.pose[:3, :3].T).T
    lean, twist, edge = np.tan(np.radians([10.0, -5.0, 4.0]))
    assert np.allclose(x, 0.2 + lean * (z - 0.1) + twist * y)
    above_m = z - 0.1 - edge * y
    assert on.sum() > 50
    assert above_m.min() >= -1e-9
    assert above_m.max() <= 0.05
    assert -0.03 <= y.min() <= y.max() <= 0.04


def test_only_pixels_on_the_edge_mix(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    sheet = scenes.Sheet(gap_m=0.103)
    sharp, mixed = scenes.bench(seen, sheet), scenes.bench(seen, sheet, beams=9)
    off = np.abs(mixed - sharp) > 0.01
    assert off.sum(axis=1).max() == 1
    assert off.any()


def test_a_ball_is_round(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    depth_m = scenes.ball(seen, (0.15, 0.01, 0.12), 0.04)
    hit = np.isfinite(depth_m)
    points = seen.pose[:3, 3] + (PINHOLE.rays()[hit] * depth_m[hit][:, np.newaxis]) @ seen.pose[:3, :3].T
    assert hit.sum() > 100
    assert np.allclose(np.linalg.norm(points - [0.15, 0.01, 0.12], axis=1), 0.04)
