import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import MeanNoise
from nlos_calibration.occluder import SheetFit, fit_sheet, look
from nlos_calibration.rig import load_rig

TOOLS = Path(__file__).parents[2] / "tools"
PINHOLE = load_rig("paper-rig").pinhole.scaled(160, 120)


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("occluder_scenes")


def view(distance_m: float, yaw_deg: float, pitch_deg: float, pinhole: Intrinsics) -> Any:
    return importlib.import_module("wall_scenes").view(distance_m, yaw_deg, pitch_deg, pinhole)


def fitted(scenes: ModuleType, noise_m: float, seed: int = 0, **how: float) -> SheetFit:
    seen = view(0.2, 45.0, 5.0, PINHOLE)
    generator = np.random.default_rng(seed)
    depth_m = scenes.bench(seen, scenes.Sheet(**how)) + generator.normal(0.0, noise_m, (120, 160))
    noise = MeanNoise()
    return fit_sheet(look(depth_m, noise, PINHOLE, seen.pose), noise, generator)


def test_exact_depth_gives_the_sheet_exactly(scenes: ModuleType) -> None:
    sheet = fitted(scenes, 0.0, lean_deg=3.0, twist_deg=-2.0)
    assert np.degrees(np.arctan(sheet.lean)) == pytest.approx(3.0, abs=1e-6)
    assert np.degrees(np.arctan(sheet.twist)) == pytest.approx(-2.0, abs=1e-6)
    assert sheet.x_m(0.1) == pytest.approx(0.2, abs=1e-9)
    assert sheet.x_m(0.15) == pytest.approx(0.2 + 0.05 * np.tan(np.radians(3.0)), abs=1e-9)
    assert sheet.tilt_deg == pytest.approx(np.degrees(np.arctan(np.hypot(sheet.lean, sheet.twist))), abs=1e-6)


def test_uncertainties_are_those_of_repeated_looks(scenes: ModuleType) -> None:
    fits = [fitted(scenes, 0.0009, seed) for seed in range(60)]
    for found, stated in (
        ([one.x_m(0.1) for one in fits], [one.x_std_m(0.1) for one in fits]),
        ([one.lean for one in fits], [one.lean_std for one in fits]),
    ):
        assert np.median(stated) == pytest.approx(np.std(found), rel=0.35)


def test_rays_meet_the_plane_where_it_stands(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    noise = MeanNoise()
    depth_m = scenes.bench(seen, scenes.Sheet())
    scene = look(depth_m, noise, PINHOLE, seen.pose)
    sheet = fit_sheet(scene, noise, np.random.default_rng(0))
    met_m = sheet.met_m(scene)
    on_sheet = met_m[..., 2] >= 0.1
    assert np.allclose(met_m[on_sheet][:, 0], 0.2, atol=1e-6)
    met, at_foot = sheet.met_by(scene), np.abs(met_m[..., 2]) < 0.01
    assert met[on_sheet].all()
    assert not met[~on_sheet & ~at_foot].any()
    assert met[at_foot].any()


def test_pixels_are_told_apart_by_the_walls_plane(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    depth_m = scenes.bench(seen, None)
    near, behind = depth_m.copy(), depth_m.copy()
    near[10:40, 20:60] *= 0.8
    near[100, 100] = 0.05  # alone, so an outlier
    behind[50:90] *= 1.2
    behind[:10] = np.nan
    scene = look(near, MeanNoise(), PINHOLE, seen.pose)
    assert scene.near.sum() == pytest.approx(30 * 40, abs=8)
    assert not scene.near[100, 100]
    assert not scene.passed[20, 40]
    scene = look(behind, MeanNoise(), PINHOLE, seen.pose)
    assert scene.behind_share == pytest.approx(40 / 110)
    assert scene.passed[60].all()
    assert not scene.passed[0].any()


def test_nothing_before_the_wall_is_no_sheet(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    scene = look(scenes.bench(seen, None), MeanNoise(), PINHOLE, seen.pose)
    with pytest.raises(WallRefusedError, match="0 points"):
        fit_sheet(scene, MeanNoise(), np.random.default_rng(0))
