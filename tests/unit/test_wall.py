import re

import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import Intrinsics, normal_from_angles, wall_from_plane
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import WallFit, fit_wall, wall_depth

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)


def pose(distance_m: float = 0.2, yaw_deg: float = 45.0, pitch_deg: float = 0.0) -> Float64:
    return wall_from_plane(normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m)


def bare(distance_m: float = 0.2, yaw_deg: float = 45.0, pitch_deg: float = 0.0) -> Float64:
    depth_m = wall_depth(pose(distance_m, yaw_deg, pitch_deg), PINHOLE)
    return np.where(depth_m < 9.0, depth_m, np.nan)


def fitted(depth_m: Float64, pinhole: Intrinsics = PINHOLE) -> WallFit:
    return fit_wall(depth_m, pinhole, np.random.default_rng(0))


def test_expected_depth_lies_on_the_wall() -> None:
    depth_m, wall_from_lidar = bare(0.23, 30.0, 10.0), pose(0.23, 30.0, 10.0)
    points = PINHOLE.rays() * depth_m[..., np.newaxis]
    np.testing.assert_allclose(points @ wall_from_lidar[2, :3] + wall_from_lidar[2, 3], 0.0, atol=1e-12)


def test_a_beam_that_never_meets_the_wall_is_infinitely_long() -> None:
    assert np.isinf(wall_depth(pose(yaw_deg=75.0), PINHOLE)[:, -1]).all()


def test_an_exact_wall_gives_the_exact_pose() -> None:
    fit = fitted(bare(0.23, 30.0, -10.0))
    np.testing.assert_allclose(fit.wall_from_lidar, pose(0.23, 30.0, -10.0), atol=1e-9)
    assert (fit.yaw_deg, fit.pitch_deg) == pytest.approx((30.0, -10.0))
    assert fit.facing_deg == pytest.approx(np.degrees(np.arccos(np.cos(np.radians(30)) * np.cos(np.radians(10)))))
    assert fit.verdict == "good"


def test_the_verdict_is_of_distance_and_angle() -> None:
    fit = fitted(bare(0.14, 5.0))
    assert fit.verdict == "out of range"
    assert "move the lidar 1 cm back" in fit.advice
    assert "turn the lidar 10 degrees aside" in fit.advice


@pytest.mark.parametrize("distance_m", [0.15, 0.30])
@pytest.mark.parametrize("yaw_deg", [15.0, 75.0, -15.0])
def test_the_ranges_include_their_ends(distance_m: float, yaw_deg: float) -> None:
    assert fitted(bare(distance_m, yaw_deg)).verdict == "good"


def test_scattered_outliers_are_accepted_and_counted() -> None:
    depth_m, generator = bare(), np.random.default_rng(1)
    depth_m[generator.random(depth_m.shape) < 0.2] *= 2.0
    fit = fitted(depth_m)
    assert fit.inlier_fraction == pytest.approx(0.8, abs=0.02)
    assert fit.distance_m == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize(("factor", "side"), [(1.5, "behind"), (0.7, "in front")])
def test_a_patch_at_another_depth_is_refused(factor: float, side: str) -> None:
    depth_m = bare()
    depth_m[20:80, 60:110] *= factor
    with pytest.raises(WallRefusedError, match=r"is not a bare wall's") as caught:
        fitted(depth_m)
    share = re.search(rf"(\d+)% (of the view is )?{side}", str(caught.value))
    assert share is not None
    assert 10 <= int(share[1]) <= 25


@pytest.mark.parametrize("seed", range(5))
def test_scattered_depth_where_the_wall_is_never_met_is_noise(seed: int) -> None:
    depth_m, generator = bare(0.25, 66.0), np.random.default_rng(seed)
    stray = generator.random(depth_m.shape) < 0.4
    depth_m[stray] = generator.uniform(0.05, 2.0, int(stray.sum()))
    assert fitted(depth_m).distance_m == pytest.approx(0.25, abs=1e-4)


def test_a_surface_where_the_wall_would_never_be_met_is_refused() -> None:
    depth_m = bare(yaw_deg=75.0)
    depth_m[:, -30:] = 0.5
    with pytest.raises(WallRefusedError, match="in front"):
        fitted(depth_m)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -0.2])
def test_a_map_without_depth_is_refused(value: float) -> None:
    with pytest.raises(WallRefusedError, match=r"0\.0% of the pixels have depth"):
        fitted(np.full((120, 160), value))


def test_a_handful_of_pixels_is_refused() -> None:
    depth_m = np.full((120, 160), np.nan)
    depth_m[50:60, 50:60] = bare()[50:60, 50:60]
    with pytest.raises(WallRefusedError, match="of the pixels have depth"):
        fitted(depth_m)


def test_a_lidar_that_looks_away_is_refused() -> None:
    with pytest.raises(WallRefusedError, match="never meets the wall"):
        fitted(bare(yaw_deg=95.0))


def test_a_wavy_wall_is_refused() -> None:
    depth_m = bare(0.3, 15.0)
    wave = 0.0035 * np.sign(np.sin(np.arange(160) / 2.0))
    with pytest.raises(WallRefusedError, match="not flat"):
        fitted(depth_m + wave)
