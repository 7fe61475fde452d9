import re
from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.flatness import Flatness
from nlos_calibration.geometry import Intrinsics, normal_from_angles
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import WallFit, WallMeasures, check_flat, fit_wall, judge, measures_of, warnings

from nlos_cam.calibrate.synthetic import view

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
FLAT = Flatness(
    bend_m=0.0, bend_deg=0.0, bend_std_m=1e-5, bend_std_deg=0.001, offset_m=0.0, offset_bend_m=0.0, offset_bend_deg=0.0
)
OFFSET = replace(FLAT, bend_m=0.006, bend_deg=0.5, offset_m=0.0045)
SPREAD = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]])
"""Shape of a covariance of the plane's slopes."""


def bare(distance_m: float = 0.2, yaw_deg: float = 45.0, pitch_deg: float = 0.0) -> Float64:
    depth_m = view(distance_m, yaw_deg, pitch_deg, PINHOLE).depth_m
    return np.where(depth_m < 9.0, depth_m, np.nan)


def fitted(depth_m: Float64, pinhole: Intrinsics = PINHOLE) -> WallFit:
    return fit_wall(depth_m, pinhole, np.random.default_rng(0))


def test_wall_depth_lies_on_the_wall_or_is_infinite() -> None:
    depth_m, wall_from_lidar = bare(0.23, 30.0, 10.0), view(0.23, 30.0, 10.0, PINHOLE).pose
    points = PINHOLE.rays() * depth_m[..., np.newaxis]
    np.testing.assert_allclose(points @ wall_from_lidar[2, :3] + wall_from_lidar[2, 3], 0.0, atol=1e-12)
    assert np.isinf(view(0.2, 75.0, 0.0, PINHOLE).depth_m[:, -1]).all()


def test_fit_wall_of_exact_depth_is_exact() -> None:
    fit = fitted(bare(0.23, 30.0, -10.0))
    np.testing.assert_allclose(fit.wall_from_lidar, view(0.23, 30.0, -10.0, PINHOLE).pose, atol=1e-9)
    assert (fit.yaw_deg, fit.pitch_deg) == pytest.approx((30.0, -10.0))
    assert fit.facing_deg == pytest.approx(np.degrees(np.arccos(np.cos(np.radians(30)) * np.cos(np.radians(10)))))
    assert fit.verdict == "good"


def test_fit_wall_out_of_range_gives_advice() -> None:
    fit = fitted(bare(0.14, 5.0))
    assert fit.verdict == "out of range"
    assert "1 cm" in fit.advice
    assert "10 degrees" in fit.advice


def test_fit_wall_refuses_what_is_not_a_wall_in_view() -> None:
    """A surface where beams miss the wall, a handful of pixels, a lidar that looks away, a wavy wall."""
    before = bare(yaw_deg=75.0)
    before[:, -30:] = 0.5
    few = np.full((120, 160), np.nan)
    few[50:60, 50:60] = bare()[50:60, 50:60]
    wavy = bare(0.3, 15.0) + 0.0035 * np.sign(np.sin(np.arange(160) / 2.0))
    for depth_m, word in ((before, "in front"), (few, "0.5%"), (bare(yaw_deg=95.0), "wall"), (wavy, "flat")):
        with pytest.raises(WallRefusedError, match=word):
            fitted(depth_m)


@pytest.mark.parametrize(
    ("distance_m", "facing_deg", "amounts", "way"),
    [
        (0.140, 45.0, "0.140 m .* 0.15 to 0.30 m.* 1 cm", "back"),
        (0.312, 45.0, "0.312 m .* 2 cm", "closer"),
        (0.200, 5.0, "5.0 degrees .* 15 to 75.* 10 degrees", "aside"),
        (0.200, 75.5, "75.5 degrees .* 1 degree ", "towards"),
    ],
)
def test_judge_out_of_range_advises_how_far_to_move(
    distance_m: float, facing_deg: float, amounts: str, way: str
) -> None:
    verdict, advice = judge(distance_m, facing_deg, FLAT, 0.0)
    assert verdict == "out of range"
    assert re.search(f"{amounts}.*{way}", advice)


@pytest.mark.parametrize("distance_m", [0.11, 0.1333, 0.3111, 0.4])
@pytest.mark.parametrize("facing_deg", [3.3, 14.2, 76.1, 88.0])
def test_judge_advice_when_followed_leads_into_range(distance_m: float, facing_deg: float) -> None:
    _, advice = judge(distance_m, facing_deg, FLAT, 0.0)
    (by_cm,), by_deg = re.findall(r" (\d+) cm", advice), int(re.findall(r" (\d+) degree", advice)[-1])
    moved_m = distance_m + (1 if distance_m < 0.15 else -1) * int(by_cm) / 100.0
    turned_deg = facing_deg + (1 if facing_deg < 15.0 else -1) * by_deg
    assert judge(moved_m, turned_deg, FLAT, 0.0)[0] == "good"


@pytest.mark.parametrize(("distance_m", "facing_deg"), [(0.15, 15.0), (0.3, 75.0), (0.1495, 14.9), (0.3005, 75.1)])
def test_judge_ranges_include_ends_and_tolerance(distance_m: float, facing_deg: float) -> None:
    assert judge(distance_m, facing_deg, FLAT, 0.0)[0] == "good"


@pytest.mark.parametrize(
    ("flat", "ripple_m", "amounts"),
    [
        (replace(FLAT, bend_m=0.0015), 0.0, ["1.5 mm", "0.00 degrees"]),
        (replace(FLAT, bend_deg=0.3), 0.0, ["0.0 mm", "0.30 degrees"]),
        (replace(FLAT, bend_deg=0.3, bend_std_deg=0.2), 0.0, ["noise", "0.30 degrees"]),
        (FLAT, 0.0013, ["1.3 mm"]),
        (OFFSET, 0.0, ["+4.5 mm", "--tape-m"]),
    ],
)
def test_judge_doubts_what_may_be_another_plane(flat: Flatness, ripple_m: float, amounts: list[str]) -> None:
    check_flat(flat, ripple_m)
    verdict, advice = judge(0.11, 45.0, flat, ripple_m)
    assert verdict == "doubtful"
    for amount in (*amounts, "4 cm"):
        assert amount in advice


def test_check_flat_refuses_what_surely_is_not_one_plane() -> None:
    refused = [replace(FLAT, bend_deg=1.2), replace(FLAT, bend_m=0.006), replace(OFFSET, offset_bend_deg=0.4)]
    for flat, ripple_m, amount in [*((flat, 0.0, "mm") for flat in refused), (FLAT, 0.0025, r"2\.5 mm")]:
        with pytest.raises(WallRefusedError, match=amount):
            check_flat(flat, ripple_m)
    check_flat(replace(FLAT, bend_m=0.006, bend_deg=1.2, bend_std_m=0.002, bend_std_deg=0.5), 0.0)  # noise alone


def test_warnings_of_ripples_and_noise_keep_the_verdict() -> None:
    assert judge(0.2, 45.0, FLAT, 0.0006)[0] == "good"
    ripples, noise = warnings(0.0006, 3.2)
    assert "0.6 mm" in ripples
    assert "3.2" in noise
    assert warnings(0.0, 1.0) == ()


def slopes_of(distance_m: float, yaw_deg: float, pitch_deg: float) -> Float64:
    return -normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)) / distance_m


def drawn(slopes: Float64, covariance: Float64, count: int = 4000) -> list[WallMeasures]:
    some = np.random.default_rng(0).multivariate_normal(slopes, covariance, count)
    return [measures_of(one, covariance) for one in some]


POSES_DEG = [(45.0, 0.0), (-60.0, 10.0), (15.0, -12.0), (74.0, 3.0)]


@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), POSES_DEG)
def test_measures_of_uncertainties_are_the_spread(yaw_deg: float, pitch_deg: float) -> None:
    slopes, covariance = slopes_of(0.2, yaw_deg, pitch_deg), 1e-6 * SPREAD
    told, others = measures_of(slopes, covariance), drawn(slopes, covariance)
    for name in ("distance_m", "yaw_deg", "pitch_deg", "facing_deg"):
        stem, unit = name.rsplit("_", 1)
        spread = float(np.std([getattr(other, name) for other in others]))
        assert getattr(told, f"{stem}_std_{unit}") == pytest.approx(spread, rel=0.06), name


@pytest.mark.parametrize("facing_deg", [0.0, 0.3, 5.0])
@pytest.mark.parametrize("shape", [np.eye(3), SPREAD])
def test_measures_of_a_wall_faced_squarely_reach_back_to_zero(facing_deg: float, shape: Float64) -> None:
    """Near 0 the angle cannot be negative: the estimate is too large, and its interval must reach back to 0."""
    slopes, covariance = slopes_of(0.2, facing_deg, 0.0), 1e-4 * shape  # tenths of a degree
    inside = [abs(one.facing_deg - facing_deg) <= 1.96 * one.facing_std_deg for one in drawn(slopes, covariance)]
    assert 0.93 <= np.mean(inside) <= 0.99
