"""A wall that is not one bare flat wall is refused with its reason, or doubted; it is never called
good.
"""

import numpy as np
import pytest
from nlos_calibration import WallFit
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from synthetic_walls import (
    PINHOLE,
    View,
    bent,
    curved,
    measured,
    patch,
    rippled,
    stepped,
    view,
    window,
    with_outliers,
)

VIEWS = [(0.2, 20.0, 5.0), (0.2, 45.0, 0.0), (0.25, -60.0, 8.0)]


@pytest.fixture(params=VIEWS, ids=str)
def seen(request: pytest.FixtureRequest) -> View:
    return view(*request.param, PINHOLE)


def measured_unless_refused(depth_m: Float64) -> WallFit | None:
    try:
        return measured(depth_m)
    except WallRefusedError:
        return None


def is_right(fit: WallFit, pose: Float64) -> bool:
    turn_deg = np.degrees(np.arccos(min(fit.wall_from_lidar[2, :3] @ pose[2, :3], 1.0)))
    return bool(turn_deg < 0.2 and abs(fit.distance_m - pose[2, 3]) < 0.001)


def only(seen: View, rows: slice | list[int], columns: slice | list[int]) -> Float64:
    """Return depth at some pixels only."""
    some = np.full(seen.depth_m.shape, np.nan)
    some[rows, columns] = seen.depth_m[rows, columns]
    return some


def hidden(seen: View, share: float, factor: float = 1.0, short_m: float = 0.0) -> Float64:
    """Return depth that is another in a patch."""
    return np.where(patch(seen, share), factor * seen.depth_m - short_m, seen.depth_m)


def assert_refused(depth_m: Float64, word: str) -> None:
    with pytest.raises(WallRefusedError, match=word):
        measured(depth_m)


def test_wall_of_three_points_is_refused(seen: View) -> None:
    assert_refused(only(seen, [10, 60, 110], [20, 140, 60]), r"0\.0%")


@pytest.mark.parametrize("width", [9, 12])
def test_wall_in_a_slit_is_refused(seen: View, width: int) -> None:
    assert_refused(only(seen, slice(None), slice(70, 70 + width)), "line")


@pytest.mark.parametrize("gap_m", [0.01, 0.05, 0.3])
def test_window_is_refused(seen: View, gap_m: float) -> None:
    assert_refused(window(seen, gap_m), r"plane|in front")


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_mirror_on_the_wall_is_refused(seen: View, share: float) -> None:
    assert_refused(hidden(seen, share, factor=3.0), "behind")


@pytest.mark.parametrize("short_m", [0.02, 0.05])
def test_saturated_patch_is_refused(seen: View, short_m: float) -> None:
    assert_refused(hidden(seen, 0.2, short_m=short_m), "in front")


@pytest.mark.parametrize("frames", [1, 8])
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_wall_with_sixty_percent_of_outliers_is_refused(
    seen: View, noise: float, frames: int
) -> None:
    stray = with_outliers(seen.depth_m, 0.6, np.random.default_rng(3))
    with pytest.raises(WallRefusedError, match="plane"):
        measured(stray, frames=frames, noise=noise)


@pytest.mark.parametrize("yaw_deg", [100.0, 125.0, -110.0])
def test_wall_that_the_axis_never_meets_is_refused(yaw_deg: float) -> None:
    with pytest.raises(WallRefusedError):
        measured(view(0.2, yaw_deg, 0.0, PINHOLE).depth_m)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -0.2])
def test_wall_without_depth_is_refused(value: float) -> None:
    with pytest.raises(WallRefusedError, match=r"0\.0%"):
        measured(np.full((120, 160), value))


@pytest.mark.parametrize("value_m", [0.15, 0.2, 1.0])
def test_wall_of_constant_depth_is_refused_as_a_stuck_lidar(value_m: float) -> None:
    with pytest.raises(WallRefusedError, match="stuck"):
        measured(np.full((120, 160), value_m), noise=0.0)


@pytest.mark.parametrize("frames", [1, 60])
def test_wall_faced_squarely_is_measured(frames: int) -> None:
    fit = measured(view(0.2, 0.0, 0.0, PINHOLE).depth_m, frames=frames)

    assert fit.distance_m == pytest.approx(0.2, abs=1e-4)
    assert fit.facing_deg <= 3.0 * fit.facing_std_deg


@pytest.mark.parametrize("share", [0.25, 0.5])
@pytest.mark.parametrize("bend_deg", [-60.0, -20.0, -8.0, -4.0, 4.0, 8.0, 20.0, 45.0])
@pytest.mark.parametrize("direction_rad", [0.0, 0.8, 1.6])
def test_two_walls_in_a_corner_are_refused_or_doubted(
    direction_rad: float, bend_deg: float, share: float
) -> None:
    """From 8 degrees refused; from 4 refused, unless the bend looks like an offset of the range,
    and then doubted.
    """
    fit = measured_unless_refused(
        bent(view(0.2, 20.0, 5.0, PINHOLE), bend_deg, share, direction_rad)[0]
    )

    assert fit is None or (abs(bend_deg) < 8.0 and fit.verdict == "doubtful")


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("bend_deg", [-1.5, -0.8, 0.8, 1.5])
def test_wall_with_a_slight_bend_is_not_averaged(seen: View, bend_deg: float, share: float) -> None:
    depth_m, main = bent(seen, bend_deg, share)
    fit = measured_unless_refused(depth_m)

    assert fit is None or fit.verdict == "doubtful" or is_right(fit, main.pose)


@pytest.mark.parametrize("radius_m", [-20.0, -8.0, -3.0, 3.0, 8.0])
def test_curved_wall_is_refused_or_doubted(seen: View, radius_m: float) -> None:
    if fit := measured_unless_refused(curved(seen, radius_m)):
        assert fit.verdict == "doubtful"
        assert fit.bend_deg > 0.14 or fit.bend_m > 0.0007


@pytest.mark.parametrize("height_m", [-0.02, -0.003, 0.003, 0.02])
@pytest.mark.parametrize("direction_rad", [0.0, 0.8, 1.6, 2.4])
def test_wall_with_a_step_is_refused_or_doubted(
    seen: View, height_m: float, direction_rad: float
) -> None:
    fit = measured_unless_refused(stepped(seen, height_m, 0.4, direction_rad))
    assert fit is None or fit.verdict == "doubtful"


def test_window_just_behind_its_frame_is_doubted(seen: View) -> None:
    assert measured(window(seen, 0.003)).verdict == "doubtful"


@pytest.mark.parametrize("short_m", [0.001, 0.002, 0.004])
@pytest.mark.parametrize("share", [0.03, 0.1, 0.3])
def test_wall_with_slight_saturation_is_doubted_or_right(
    seen: View, share: float, short_m: float
) -> None:
    fit = measured_unless_refused(hidden(seen, share, short_m=short_m))
    distance_m = pytest.approx(seen.pose[2, 3], abs=0.001)

    assert fit is None or fit.verdict == "doubtful" or fit.distance_m == distance_m


@pytest.mark.parametrize("amplitude_m", [0.0005, 0.001, 0.002])
@pytest.mark.parametrize("waves", [3.0, 8.0])
def test_wall_with_ripples_of_the_lidar_is_measured(
    seen: View, amplitude_m: float, waves: float
) -> None:
    fit = measured(rippled(seen, amplitude_m, waves, np.random.default_rng(1)))

    assert is_right(fit, seen.pose)
    assert fit.verdict == "good" or amplitude_m > 0.001
    assert amplitude_m < 0.001 or any("ripples" in warning for warning in fit.warnings)
