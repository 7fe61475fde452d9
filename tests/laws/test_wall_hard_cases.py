"""Walls that are not one bare flat wall: each is refused with its reason, or doubted; none is called good."""

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import WallFit, fit_wall

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
TOOLS = Path(__file__).parents[2] / "tools"
VIEWS = [(0.2, 20.0, 5.0), (0.2, 45.0, 0.0), (0.25, -60.0, 8.0)]


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("wall_scenes")


@pytest.fixture(params=VIEWS, ids=str)
def seen(scenes: ModuleType, request: pytest.FixtureRequest) -> object:
    return scenes.view(*request.param, PINHOLE)


def measured(scenes: ModuleType, depth_m: Float64, *, frames: int = 8, noise: float = 1.0, seed: int = 0) -> WallFit:
    generator = np.random.default_rng(seed)
    mean = scenes.looked_at(depth_m, generator, frames=frames, noise=noise)
    return fit_wall(mean.mean_m(), PINHOLE, generator, mean.noise())


def only(depth_m: Float64, rows: slice | list[int], columns: slice | list[int]) -> Float64:
    """Depth at some pixels alone."""
    some = np.full(depth_m.shape, np.nan)
    some[rows, columns] = depth_m[rows, columns]
    return some


def test_three_points_are_no_wall(scenes: ModuleType, seen: object) -> None:
    with pytest.raises(WallRefusedError, match=r"0\.0% of the pixels have depth"):
        measured(scenes, only(seen.depth_m, [10, 60, 110], [20, 140, 60]), frames=1)


@pytest.mark.parametrize("width", [9, 12])
def test_a_wall_seen_through_a_slit_is_a_line(scenes: ModuleType, seen: object, width: int) -> None:
    with pytest.raises(WallRefusedError, match="in a line"):
        measured(scenes, only(seen.depth_m, slice(None), slice(70, 70 + width)))


@pytest.mark.parametrize("frames", [1, 8])
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_sixty_percent_of_outliers_are_too_many(scenes: ModuleType, seen: object, noise: float, frames: int) -> None:
    stray = scenes.with_outliers(seen.depth_m, 0.6, np.random.default_rng(3))
    with pytest.raises(WallRefusedError, match="lies on one plane"):
        measured(scenes, stray, frames=frames, noise=noise)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -0.2])
def test_no_depth_is_no_wall(scenes: ModuleType, value: float) -> None:
    with pytest.raises(WallRefusedError, match="of the pixels have depth"):
        measured(scenes, np.full((120, 160), value))


@pytest.mark.parametrize("yaw_deg", [100.0, 125.0, -110.0])
def test_a_wall_that_the_axis_never_meets_is_refused(scenes: ModuleType, yaw_deg: float) -> None:
    with pytest.raises(WallRefusedError, match=r"never meets the wall|seen edge on|have depth"):
        measured(scenes, scenes.view(0.2, yaw_deg, 0.0, PINHOLE).depth_m)


@pytest.mark.parametrize("value_m", [0.15, 0.2, 1.0])
def test_a_stuck_lidar_is_no_wall_faced_squarely(scenes: ModuleType, value_m: float) -> None:
    with pytest.raises(WallRefusedError, match="as if the lidar were stuck"):
        measured(scenes, np.full((120, 160), value_m), noise=0.0)


@pytest.mark.parametrize("frames", [1, 60])
def test_a_wall_faced_squarely_is_not_stuck(scenes: ModuleType, frames: int) -> None:
    fit = measured(scenes, scenes.view(0.2, 0.0, 0.0, PINHOLE).depth_m, frames=frames)
    assert fit.distance_m == pytest.approx(0.2, abs=1e-4)
    assert fit.facing_deg <= 3.0 * fit.facing_std_deg


@pytest.mark.parametrize("share", [0.25, 0.5])
@pytest.mark.parametrize("bend_deg", [-60.0, -20.0, -8.0, -4.0, 4.0, 8.0, 20.0, 45.0])
@pytest.mark.parametrize("direction_rad", [0.0, 0.8, 1.6])
def test_two_walls_in_a_corner_are_refused_or_one_is_doubted(
    scenes: ModuleType, direction_rad: float, bend_deg: float, share: float
) -> None:
    """From 8 degrees refused; from 4 refused, unless the bend looks like an offset of the range, and then doubted."""
    depth_m, main = scenes.bent(scenes.view(0.2, 20.0, 5.0, PINHOLE), bend_deg, share, direction_rad)
    try:
        fit = measured(scenes, depth_m)
    except WallRefusedError:
        return
    assert abs(bend_deg) < 8.0
    assert fit.verdict == "doubtful", main


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("bend_deg", [-1.5, -0.8, 0.8, 1.5])
def test_a_slight_bend_is_not_averaged_away(scenes: ModuleType, seen: object, bend_deg: float, share: float) -> None:
    depth_m, main = scenes.bent(seen, bend_deg, share)
    try:
        fit = measured(scenes, depth_m)
    except WallRefusedError:
        return
    turn_deg = np.degrees(np.arccos(min(fit.wall_from_lidar[2, :3] @ main.pose[2, :3], 1.0)))
    right = turn_deg < 0.2 and abs(fit.distance_m - main.pose[2, 3]) < 0.001
    assert fit.verdict == "doubtful" or right


@pytest.mark.parametrize("radius_m", [-20.0, -8.0, -3.0, 3.0, 8.0])
def test_a_curved_wall_is_refused_or_doubted(scenes: ModuleType, seen: object, radius_m: float) -> None:
    try:
        fit = measured(scenes, scenes.curved(seen, radius_m))
    except WallRefusedError:
        return
    assert fit.verdict == "doubtful"
    assert fit.bend_deg > 0.14 or fit.bend_m > 0.0007


@pytest.mark.parametrize("height_m", [-0.02, -0.003, 0.003, 0.02])
@pytest.mark.parametrize("direction_rad", [0.0, 0.8, 1.6, 2.4])
def test_a_step_in_the_wall_is_refused_or_doubted(
    scenes: ModuleType, seen: object, height_m: float, direction_rad: float
) -> None:
    try:
        fit = measured(scenes, scenes.stepped(seen, height_m, 0.4, direction_rad))
    except WallRefusedError:
        return
    assert fit.verdict == "doubtful"


@pytest.mark.parametrize("gap_m", [0.01, 0.05, 0.3])
def test_a_window_frame_and_what_is_behind_it_are_two_planes(scenes: ModuleType, seen: object, gap_m: float) -> None:
    with pytest.raises(WallRefusedError, match=r"lies on one plane|is behind the wall's plane|in front of it"):
        measured(scenes, scenes.window(seen, gap_m))


def test_a_pane_just_behind_its_frame_is_doubted(scenes: ModuleType, seen: object) -> None:
    assert measured(scenes, scenes.window(seen, 0.003)).verdict == "doubtful"


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_a_mirror_on_the_wall_is_refused(scenes: ModuleType, seen: object, share: float) -> None:
    mirrored = np.where(scenes.patch(seen, share), 3.0 * seen.depth_m, seen.depth_m)
    with pytest.raises(WallRefusedError, match="behind"):
        measured(scenes, mirrored)


@pytest.mark.parametrize("short_m", [0.02, 0.05])
def test_a_saturated_patch_is_refused(scenes: ModuleType, seen: object, short_m: float) -> None:
    with pytest.raises(WallRefusedError, match="in front of it"):
        measured(scenes, np.where(scenes.patch(seen, 0.2), seen.depth_m - short_m, seen.depth_m))


@pytest.mark.parametrize("short_m", [0.001, 0.002, 0.004])
@pytest.mark.parametrize("share", [0.03, 0.1, 0.3])
def test_a_slightly_saturated_patch_does_not_move_the_wall_unnoticed(
    scenes: ModuleType, seen: object, share: float, short_m: float
) -> None:
    try:
        fit = measured(scenes, np.where(scenes.patch(seen, share), seen.depth_m - short_m, seen.depth_m))
    except WallRefusedError:
        return
    assert fit.verdict == "doubtful" or fit.distance_m == pytest.approx(seen.pose[2, 3], abs=0.001)


@pytest.mark.parametrize("amplitude_m", [0.0005, 0.001, 0.002])
@pytest.mark.parametrize("waves", [3.0, 8.0])
def test_ripples_of_the_lidar_pass(scenes: ModuleType, seen: object, amplitude_m: float, waves: float) -> None:
    fit = measured(scenes, scenes.rippled(seen, amplitude_m, waves, np.random.default_rng(1)))
    assert fit.distance_m == pytest.approx(seen.pose[2, 3], abs=0.001)
    assert np.degrees(np.arccos(min(fit.wall_from_lidar[2, :3] @ seen.pose[2, :3], 1.0))) < 0.2
    assert fit.verdict == "good" or amplitude_m > 0.001
    assert amplitude_m < 0.001 or any("ripples" in warning for warning in fit.warnings)
