import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from nlos_calibration.errors import OccluderRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import MeanNoise, depth_noise_m
from nlos_calibration.occluder import MAX_BEHIND, OccluderFit, find_occluder, rig_with_occluder
from nlos_calibration.rig import load_rig
from numpy.typing import NDArray

TOOLS = Path(__file__).parents[2] / "tools"
PAPER = load_rig("paper-rig")
PINHOLE = PAPER.pinhole.scaled(160, 120)
NOISE = MeanNoise(np.full(1, 30.0))
PIXEL_M = 0.25 * 0.9 / PINHOLE.fx
"""Of height on the paper's sheet, at its edge: 0.2 m / sin^2 for each radian."""


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("occluder_scenes")


def view(distance_m: float, yaw_deg: float, pitch_deg: float, pinhole: Intrinsics) -> Any:
    return importlib.import_module("wall_scenes").view(distance_m, yaw_deg, pitch_deg, pinhole)


def noisy(depth_m: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    """The mean of 30 frames."""
    seen_m = np.where(depth_m < 9.0, depth_m, np.nan)
    return seen_m + np.random.default_rng(seed).normal(0.0, 30**-0.5, depth_m.shape) * depth_noise_m(seen_m)


def found(scenes: ModuleType, sheet: object, yaw_deg: float = 45.0, **stds: float) -> OccluderFit:
    seen = view(0.2, yaw_deg, 0.0, PINHOLE)
    return look(seen, noisy(scenes.bench(seen, sheet)), **stds)


def look(seen: Any, depth_m: NDArray[np.float64], **stds: float) -> OccluderFit:
    return find_occluder(depth_m, NOISE, PINHOLE, seen.pose, np.random.default_rng(1), **stds)


def test_the_papers_occluder_is_found_to_half_a_pixel(scenes: ModuleType) -> None:
    fit = found(scenes, scenes.Sheet())
    assert abs(fit.x_m - 0.2) < 1e-4
    assert abs(fit.gap_m - 0.1) <= 0.6 * PIXEL_M
    assert abs(fit.tilt_deg) < 0.1
    assert 0.0 < fit.x_std_m < 1e-4
    assert fit.gap_std_m == pytest.approx(PIXEL_M / 12**0.5, rel=0.2)
    assert fit.pixels.mean() == pytest.approx(0.26, abs=0.02)
    assert fit.warnings == ()


def test_a_sheet_that_leans_a_little_is_told_as_such(scenes: ModuleType) -> None:
    fit = found(scenes, scenes.Sheet(lean_deg=3.0, twist_deg=-2.0, edge_deg=2.0))
    assert fit.tilt_deg == pytest.approx(3.0, abs=0.1)
    assert fit.twist_deg == pytest.approx(-2.0, abs=0.1)
    assert fit.edge_deg == pytest.approx(2.0, abs=0.3)
    assert abs(fit.x_m - 0.2) < 1e-3


def test_the_walls_own_uncertainty_is_in_that_of_the_occluder(scenes: ModuleType) -> None:
    sheet = scenes.Sheet()
    plain, less_sure = found(scenes, sheet), found(scenes, sheet, distance_std_m=0.003, yaw_std_deg=0.5)
    turn = np.radians(0.5)
    assert less_sure.x_std_m == pytest.approx(np.hypot(plain.x_std_m, 0.1 * turn), rel=0.02)
    expected = np.sqrt(plain.gap_std_m**2 + 0.003**2 + (0.2 * turn) ** 2)
    assert less_sure.gap_std_m == pytest.approx(expected, rel=0.02)


def test_flying_pixels_do_not_bias_the_gap(scenes: ModuleType) -> None:
    errors_m = []
    for step in np.linspace(0.0, 2.0, 9):
        seen = view(0.2, 45.0, 0.0, PINHOLE)
        gap_m = 0.1 + step * PIXEL_M
        fit = look(seen, noisy(scenes.bench(seen, scenes.Sheet(gap_m=gap_m), beams=5)))
        errors_m.append(fit.gap_m - gap_m)
        assert abs(errors_m[-1]) <= 1.96 * fit.gap_std_m
    assert abs(np.mean(errors_m)) < 0.35 * PIXEL_M


def test_an_object_that_wins_some_beams_is_tolerated_and_told(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    depth_m = scenes.bench(seen, scenes.Sheet())
    on_wall = np.flatnonzero(depth_m == scenes.bench(seen, None))
    some = np.random.default_rng(0).choice(on_wall, depth_m.size // 5, replace=False)
    depth_m.flat[some] += 0.15
    fit = look(seen, noisy(depth_m))
    assert abs(fit.gap_m - 0.1) < 2 * PIXEL_M
    assert any("20% of the depth is behind the wall" in told for told in fit.warnings)


def test_an_object_that_wins_most_beams_is_refused(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    depth_m = scenes.bench(seen, scenes.Sheet())
    depth_m[depth_m == scenes.bench(seen, None)] += 0.15
    with pytest.raises(OccluderRefusedError, match=rf"behind the wall \({MAX_BEHIND:.0%} allowed.*take the hidden"):
        look(seen, noisy(depth_m))


def test_a_finger_beside_the_sheet_is_told(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    finger = scenes.ball(seen, (0.12, 0.02, 0.06), 0.015)
    fit = look(seen, noisy(np.minimum(scenes.bench(seen, scenes.Sheet()), finger)))
    assert abs(fit.x_m - 0.2) < 1e-3
    assert "not on the occluder: take away" in fit.warnings[0]


@pytest.mark.parametrize(
    ("yaw_deg", "sheet", "why"),
    [
        (45.0, None, r"no occluder is in view: .* reach to x = 0\.5\d m"),
        (15.0, {}, r"no occluder is in view: .* reach to x = 0\.12 m .*by hand"),
        (60.0, None, r"reach without end"),
        (29.0, {}, r"the view holds \d columns .* 4 needed: turn the lidar towards"),
        (45.0, {"lean_deg": 8.0}, r"8\.\d degrees off the plane x = const \(5 allowed\): it leans by \+8\.0"),
        (45.0, {"twist_deg": -7.0}, r"twisted by -7\.0"),
        (45.0, {"edge_deg": 7.0}, r"edge is [67]\.\d degrees off the wall"),
        (45.0, {"gap_m": 0.0}, r"touches the wall \(gap"),
        (45.0, {"gap_m": -0.05}, r"touches the wall \(gap"),
        (-45.0, {"x_m": -0.2}, r"x = -0\.200 m, on the wrong side"),
        (45.0, {"bottom_m": -0.02, "top_m": 0.03}, r"no sheet \(seen in \d+% of the rows\)"),
        (75.0, {"x_m": 0.1, "gap_m": 0.05}, r"edge is out of view: .* turn the lidar away"),
        (70.0, {"x_m": 0.12, "gap_m": 0.22}, r"edge is seen to \d+ mm only \(5 allowed\)"),
    ],
)
def test_what_cannot_be_trusted_is_refused_with_the_reason(
    scenes: ModuleType, yaw_deg: float, sheet: dict[str, float] | None, why: str
) -> None:
    with pytest.raises(OccluderRefusedError, match=why):
        found(scenes, None if sheet is None else scenes.Sheet(**sheet), yaw_deg)


@pytest.mark.parametrize("centre_m", [(0.2, 0.02, 0.13), (0.1, 0.0, 0.1)])
def test_a_fist_is_no_sheet(scenes: ModuleType, centre_m: tuple[float, float, float]) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    with pytest.raises(OccluderRefusedError, match=r"no sheet \(.*mm RMS off a plane|on a plane|on no plane"):
        look(seen, noisy(np.minimum(scenes.bench(seen, None), scenes.ball(seen, centre_m, 0.045))))


def test_a_box_beside_the_sheet_is_not_averaged_with_it(scenes: ModuleType) -> None:
    seen = view(0.2, 45.0, 0.0, PINHOLE)
    both = np.minimum(scenes.bench(seen, scenes.Sheet()), scenes.bench(seen, scenes.Sheet(0.08, 0.05, height_m=0.06)))
    with pytest.raises(OccluderRefusedError, match=r"no sheet \(\d+% of it lie on a plane\)"):
        look(seen, noisy(both))


def test_a_rig_takes_the_occluder() -> None:
    rig = rig_with_occluder(PAPER, 0.21, 0.09)
    assert (rig.occluder.x_m, rig.occluder.z_min_m) == (0.21, 0.09)
    assert rig.object_box == PAPER.object_box
