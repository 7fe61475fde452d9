import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import MeanNoise, depth_noise_m, normal_from_angles
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import CalibrationError, WallRefusedError
from nlos_calibration.flatness import Flatness, Ripples, flatness, ripples
from nlos_calibration.plane import PlaneFit, fit_depth
from nlos_calibration.range_offset import (
    MAX_OFFSET_M,
    TAPE_STD_M,
    FitWith,
    distance_per_offset,
    fit_with_board_distance,
    fit_with_tape_distance,
)
from nlos_calibration.wall import (
    WallFit,
    WallMeasures,
    check_flat,
    fit_wall,
    judge,
    measures_of,
    warnings,
)
from synthetic_walls import PINHOLE, view

RAYS = PINHOLE.rays()
COLUMN = np.broadcast_to(np.arange(160), (120, 160))
ROW = np.broadcast_to(np.arange(120)[:, np.newaxis], (120, 160))
FLAT = Flatness(
    bend_m=0.0,
    bend_deg=0.0,
    bend_std_m=1e-5,
    bend_std_deg=0.001,
    offset_m=0.0,
    offset_bend_m=0.0,
    offset_bend_deg=0.0,
)
OFFSET = replace(FLAT, bend_m=0.006, bend_deg=0.5, offset_m=0.0045)
SPREAD = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]])


def bare(distance_m: float = 0.2, yaw_deg: float = 45.0, pitch_deg: float = 0.0) -> Float64:
    depth_m = view(distance_m, yaw_deg, pitch_deg, PINHOLE).depth_m
    return np.where(depth_m < 9.0, depth_m, np.nan)


def test_wall_depth_lies_on_the_wall_or_is_infinite() -> None:
    depth_m = bare(0.23, 30.0, 10.0)
    wall_from_lidar = view(0.23, 30.0, 10.0, PINHOLE).pose
    points = PINHOLE.rays() * depth_m[..., np.newaxis]
    height_m = points @ wall_from_lidar[2, :3] + wall_from_lidar[2, 3]

    np.testing.assert_allclose(height_m, 0.0, atol=1e-12)
    assert np.isinf(view(0.2, 75.0, 0.0, PINHOLE).depth_m[:, -1]).all()


def test_fit_wall_of_exact_depth_is_exact() -> None:
    fit = fit_wall(bare(0.23, 30.0, -10.0), PINHOLE, np.random.default_rng(0))
    pose = view(0.23, 30.0, -10.0, PINHOLE).pose

    np.testing.assert_allclose(fit.wall_from_lidar, pose, atol=1e-9)
    assert fit.verdict == "good"
    assert fit.inlier_fraction == 1.0
    assert fit.residual_m < 1e-9


def test_fit_wall_has_the_angles_of_its_pose() -> None:
    fit = fit_wall(bare(0.23, 30.0, -10.0), PINHOLE, np.random.default_rng(0))
    facing_rad = np.arccos(np.cos(np.radians(30.0)) * np.cos(np.radians(10.0)))

    assert fit.yaw_deg == pytest.approx(30.0)
    assert fit.pitch_deg == pytest.approx(-10.0)
    assert fit.facing_deg == pytest.approx(np.degrees(facing_rad))


def test_fit_wall_refuses_a_corrugated_wall() -> None:
    depth_m = bare(0.3, 15.0) + 0.0035 * np.sign(np.sin(np.arange(160) / 2.0))
    with pytest.raises(WallRefusedError, match="flat"):
        fit_wall(depth_m, PINHOLE, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("distance_m", "facing_deg", "amounts", "way"),
    [
        (0.140, 45.0, "0.140 m .* 0.15 to 0.30 m.* 1 cm", "back"),
        (0.312, 45.0, "0.312 m .* 2 cm", "closer"),
        (0.200, 5.0, "5.0 degrees .* 15 to 75.* 10 degrees", "aside"),
        (0.200, 75.5, "75.5 degrees .* 1 degree ", "towards"),
    ],
)
def test_judge_out_of_range_advises_a_distance(
    distance_m: float, facing_deg: float, amounts: str, way: str
) -> None:
    verdict, advice = judge(distance_m, facing_deg, FLAT, 0.0)

    assert verdict == "out of range"
    assert re.search(f"{amounts}.*{way}", advice)


@pytest.mark.parametrize("distance_m", [0.11, 0.1333, 0.3111, 0.4])
@pytest.mark.parametrize("facing_deg", [3.3, 14.2, 76.1, 88.0])
def test_judge_advice_when_followed_leads_into_range(distance_m: float, facing_deg: float) -> None:
    _, advice = judge(distance_m, facing_deg, FLAT, 0.0)
    (by_cm,) = re.findall(r" (\d+) cm", advice)
    by_deg = int(re.findall(r" (\d+) degree", advice)[-1])
    moved_m = distance_m + (1 if distance_m < 0.15 else -1) * int(by_cm) / 100.0
    turned_deg = facing_deg + (1 if facing_deg < 15.0 else -1) * by_deg

    assert judge(moved_m, turned_deg, FLAT, 0.0)[0] == "good"


@pytest.mark.parametrize(
    ("distance_m", "facing_deg"), [(0.15, 15.0), (0.3, 75.0), (0.1495, 14.9), (0.3005, 75.1)]
)
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
def test_judge_doubts_what_may_be_another_plane(
    flat: Flatness, ripple_m: float, amounts: list[str]
) -> None:
    check_flat(flat, ripple_m)
    verdict, advice = judge(0.11, 45.0, flat, ripple_m)

    assert verdict == "doubtful"

    for amount in (*amounts, "4 cm"):
        assert amount in advice


@pytest.mark.parametrize(
    ("flat", "ripple_m", "amount"),
    [
        (replace(FLAT, bend_deg=1.2), 0.0, "mm"),
        (replace(FLAT, bend_m=0.006), 0.0, "mm"),
        (replace(OFFSET, offset_bend_deg=0.4), 0.0, "mm"),
        (FLAT, 0.0025, r"2\.5 mm"),
    ],
)
def test_check_flat_refuses_what_surely_is_not_one_plane(
    flat: Flatness, ripple_m: float, amount: str
) -> None:
    with pytest.raises(WallRefusedError, match=amount):
        check_flat(flat, ripple_m)


def test_check_flat_accepts_a_bend_within_noise() -> None:
    uncertain = replace(FLAT, bend_m=0.006, bend_deg=1.2, bend_std_m=0.002, bend_std_deg=0.5)
    check_flat(uncertain, 0.0)


def test_warnings_of_ripples_and_noise_keep_the_verdict() -> None:
    assert judge(0.2, 45.0, FLAT, 0.0006)[0] == "good"

    ripples, noise = warnings(0.0006, 3.2)

    assert "0.6 mm" in ripples
    assert "3.2" in noise
    assert warnings(0.0, 1.0) == ()


def slopes_of(yaw_deg: float, pitch_deg: float) -> Float64:
    return -normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)) / 0.2


def drawn(slopes: Float64, covariance: Float64, count: int = 4000) -> list[WallMeasures]:
    some = np.random.default_rng(0).multivariate_normal(slopes, covariance, count)
    return [measures_of(one, covariance) for one in some]


@pytest.mark.parametrize(
    ("yaw_deg", "pitch_deg"), [(45.0, 0.0), (-60.0, 10.0), (15.0, -12.0), (74.0, 3.0)]
)
def test_measures_of_uncertainties_are_the_spread(yaw_deg: float, pitch_deg: float) -> None:
    slopes = slopes_of(yaw_deg, pitch_deg)
    covariance = 1e-6 * SPREAD
    stated = measures_of(slopes, covariance)
    others = drawn(slopes, covariance)
    for name in ("distance_m", "yaw_deg", "pitch_deg", "facing_deg"):
        stem, unit = name.rsplit("_", 1)
        spread = float(np.std([getattr(other, name) for other in others]))
        assert getattr(stated, f"{stem}_std_{unit}") == pytest.approx(spread, rel=0.06), name


@pytest.mark.parametrize("facing_deg", [0.0, 0.3, 5.0])
@pytest.mark.parametrize("shape", [np.eye(3), SPREAD])
def test_measures_of_a_wall_faced_squarely_reach_back_to_zero(
    facing_deg: float, shape: Float64
) -> None:
    """Near 0 the angle cannot be negative: the estimate is too large, and its interval must reach
    back to 0.
    """
    slopes = slopes_of(facing_deg, 0.0)
    covariance = 1e-4 * shape  # tenths of a degree
    inside = [
        abs(one.facing_deg - facing_deg) <= 1.96 * one.facing_std_deg
        for one in drawn(slopes, covariance)
    ]

    assert 0.93 <= np.mean(inside) <= 0.99


WALL_M = view(0.2, 20.0, 6.0, PINHOLE).depth_m


def plane_of(depth_m: Float64, *, noise: float = 1.0, seed: int = 0) -> PlaneFit:
    errors = np.random.default_rng(seed).standard_normal(depth_m.shape)
    noisy_m = depth_m + noise * depth_noise_m(WALL_M) * errors / 5
    samples = MeanNoise(np.full(depth_m.size, 25.0))
    return fit_depth(RAYS.reshape(-1, 3), noisy_m.ravel(), np.random.default_rng(0), samples)


def judged(depth_m: Float64, **how: Any) -> Flatness:
    return flatness(plane_of(depth_m, **how), RAYS)


def rippled(extra_m: Float64 | float, **how: Any) -> Ripples:
    return ripples(plane_of(WALL_M + extra_m, **how), RAYS)


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0])
def test_flatness_of_noise_has_no_bend(yaw_deg: float, noise: float) -> None:
    flat = judged(view(0.2, yaw_deg, 6.0, PINHOLE).depth_m, noise=noise)

    assert flat.bend_m < 5.0 * flat.bend_std_m
    assert flat.bend_deg < 5.0 * flat.bend_std_deg < 0.4


def test_flatness_bend_is_the_angle_that_each_side_turns() -> None:
    """Two walls that meet in the middle of the view, 2 degrees apart: each is 1 degree off the
    mean.
    """
    slope = np.tan(np.radians(2.0)) * (np.maximum(COLUMN - 80, 0) / PINHOLE.fx) * 0.2
    flat = judged(WALL_M + slope)

    assert flat.bend_deg == pytest.approx(1.0, abs=0.35)
    assert flat.bend_deg > 10.0 * flat.bend_std_deg


@pytest.mark.parametrize("offset_m", [-0.0045, 0.002, 0.0045])
def test_flatness_finds_a_range_offset_on_an_oblique_wall(offset_m: float) -> None:
    oblique_m = view(0.2, 50.0, 6.0, PINHOLE).depth_m
    flat = judged(oblique_m - offset_m)

    assert flat.offset_m == pytest.approx(offset_m, rel=0.1)
    assert abs(judged(oblique_m).offset_m) < 1e-4
    assert flat.bend_deg > 3.0 * flat.offset_bend_deg


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
def test_ripples_of_noise_are_none(noise: float) -> None:
    found = rippled(0.0, noise=noise)

    assert found.rms_m < 5e-5 * noise
    assert found.correlation == 1.0
    np.testing.assert_array_equal(found.covariance, plane_of(WALL_M, noise=noise).covariance)


@pytest.mark.slow
def test_ripples_are_rarely_found_in_independent_noise() -> None:
    assert np.mean([rippled(0.0, seed=seed).correlation > 1.0 for seed in range(60)]) <= 0.05


@pytest.mark.parametrize("amplitude_m", [0.0005, 0.0015])
def test_ripples_have_their_size_and_widen_the_covariance(amplitude_m: float) -> None:
    wave_m = amplitude_m * np.sin(2.0 * np.pi * COLUMN / 27.0)
    found = rippled(wave_m)
    # the wall is nearly faced squarely, so that depth and distance are alike
    assert found.rms_m == pytest.approx(amplitude_m / np.sqrt(2.0), rel=0.15)
    assert found.correlation > 10.0

    scaled = found.correlation * plane_of(WALL_M + wave_m).covariance
    grown = np.linalg.eigvalsh(found.covariance - scaled)

    assert grown.min() > -1e-9 * np.abs(found.covariance).max()


def test_ripples_need_neighbours_that_agree() -> None:
    found = rippled(0.0006 * (-1.0) ** (COLUMN + ROW))

    assert found.correlation == 1.0
    assert found.rms_m < 1e-4


def test_ripples_of_exact_depth_are_none() -> None:
    exact = ripples(fit_depth(RAYS.reshape(-1, 3), WALL_M.ravel(), np.random.default_rng(0)), RAYS)

    assert exact.rms_m < 1e-9
    assert np.isfinite(exact.covariance).all()


PITCH_DEG = 3.0


def read_as(depth_m: Float64, seed: int = 0) -> FitWith:
    """Return the wall fit, by offset, of a lidar that reads `depth_m` with a fifth of one sample's
    noise.
    """
    errors = np.random.default_rng(seed).standard_normal(depth_m.shape)
    noisy_m = depth_m + 0.2 * depth_noise_m(depth_m) * errors

    def fit_with(offset_m: float, origin_m: float) -> WallFit:
        return fit_wall(noisy_m + offset_m, PINHOLE, np.random.default_rng(0), origin_m=origin_m)

    return fit_with


@pytest.mark.parametrize("offset_m", [-0.0045, 0.003])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0, 65.0])
def test_tape_offset_is_added_to_depth_that_is_too_short(yaw_deg: float, offset_m: float) -> None:
    """The beams meet at the front glass and every depth lacks the offset: the corrected pose is the
    true one.
    """
    taped = fit_with_tape_distance(read_as(bare(0.2, yaw_deg, PITCH_DEG) - offset_m), 0.2)

    assert taped.cause == "depth"
    assert taped.offset_m == pytest.approx(offset_m, abs=3e-5)
    np.testing.assert_allclose(
        taped.fit.wall_from_lidar, view(0.2, yaw_deg, PITCH_DEG, PINHOLE).pose, atol=3e-4
    )
    assert taped.fit.verdict == "good"


@pytest.mark.parametrize(
    ("yaw_deg", "offset_m"), [(45.0, 0.02), (70.0, 0.013), (75.0, 0.009), (75.0, 0.013)]
)
def test_tape_offset_of_depth_is_found_where_the_origins_is_not(
    yaw_deg: float, offset_m: float
) -> None:
    """On an oblique wall an origin would have to be up to three times as far off."""
    taped = fit_with_tape_distance(read_as(bare(0.2, yaw_deg) - offset_m), 0.2)

    assert taped.cause == "depth"
    assert taped.offset_m == pytest.approx(offset_m, abs=5e-5)


def test_wall_in_doubt_with_a_tape_does_not_ask_for_one() -> None:
    short = read_as(bare(0.2, 45.0) - 0.0045)
    plain = short(0.0, 0.0)
    misread = fit_with_tape_distance(short, plain.distance_m)

    assert "--tape-m" in plain.advice
    assert "--tape-m" not in misread.fit.advice
    assert "measure the distance again" in misread.fit.advice


@pytest.mark.parametrize("offset_m", [-0.0045, 0.0045])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0, 65.0])
def test_tape_offset_of_the_origin_moves_the_pose_along_the_axis(
    yaw_deg: float, offset_m: float
) -> None:
    """Depth is right, but its zero lies offset_m nearer to the wall than the front glass."""
    true = view(0.2, yaw_deg, PITCH_DEG, PINHOLE).pose
    cosine = -true[2, 2]
    taped = fit_with_tape_distance(read_as(bare(0.2, yaw_deg, PITCH_DEG)), 0.2 + offset_m * cosine)

    assert taped.cause == "origin"
    assert taped.offset_m == pytest.approx(offset_m, abs=3e-5)
    assert taped.fit.distance_m == pytest.approx(0.2 + offset_m * cosine, abs=1e-9)
    assert taped.fit.wall_from_lidar[2, 3] == taped.fit.distance_m
    np.testing.assert_allclose(taped.fit.wall_from_lidar[:3, :3], true[:3, :3], atol=3e-4)


def test_tape_offset_of_a_wall_faced_squarely_is_the_origins() -> None:
    """Both causes bend it by noise alone, by a little more or less as chance has it."""
    causes = {
        fit_with_tape_distance(read_as(bare(0.2, 0.0), seed), 0.201).cause for seed in range(5)
    }

    assert causes == {"origin"}


@pytest.mark.parametrize("yaw_deg", [0.0, 20.0, -45.0, 75.0])
def test_distance_per_offset_is_that_of_the_fits(yaw_deg: float) -> None:
    fit_with = read_as(bare(0.2, yaw_deg, PITCH_DEG))
    before = fit_with(0.0, 0.0)
    growth_m = fit_with(0.001, 0.0).distance_m - before.distance_m

    assert distance_per_offset(before, PINHOLE) == pytest.approx(growth_m / 0.001, rel=0.01)


def test_tape_that_agrees_changes_only_the_uncertainty() -> None:
    fit_with = read_as(bare(0.2, 45.0, PITCH_DEG))
    plain = fit_with(0.0, 0.0)
    taped = fit_with_tape_distance(fit_with, plain.distance_m)

    assert taped.offset_m == 0.0
    np.testing.assert_array_equal(taped.fit.wall_from_lidar, plain.wall_from_lidar)
    assert taped.fit.distance_std_m == TAPE_STD_M


def test_tape_offset_is_less_certain_on_an_oblique_wall() -> None:
    squarely = fit_with_tape_distance(read_as(bare(0.2, 20.0, PITCH_DEG)), 0.201)
    obliquely = fit_with_tape_distance(read_as(bare(0.2, 65.0, PITCH_DEG)), 0.201)

    assert squarely.offset_std_m == pytest.approx(TAPE_STD_M / np.cos(np.radians(20.0)), rel=0.02)
    assert obliquely.offset_std_m > 1.5 * squarely.offset_std_m


@pytest.mark.parametrize("tape_m", [0.1, 0.3])
def test_tape_far_from_the_measured_distance_is_refused(tape_m: float) -> None:
    with pytest.raises(CalibrationError, match=f"{1e3 * tape_m:.1f} mm"):
        fit_with_tape_distance(read_as(bare(0.2, 45.0, PITCH_DEG)), tape_m)


BOARD_STD_M = 0.0005


@pytest.mark.parametrize("offset_m", [-0.02, -0.0045, 0.003, 0.02])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0, 65.0])
def test_board_distance_gives_the_offset_of_the_depth(yaw_deg: float, offset_m: float) -> None:
    found = fit_with_board_distance(
        read_as(bare(0.2, yaw_deg, PITCH_DEG) - offset_m), 0.2, BOARD_STD_M
    )

    assert found.cause == "depth"
    assert found.offset_m == pytest.approx(offset_m, abs=3e-5)
    assert found.fit.distance_std_m == BOARD_STD_M
    np.testing.assert_allclose(
        found.fit.wall_from_lidar, view(0.2, yaw_deg, PITCH_DEG, PINHOLE).pose, atol=3e-4
    )


def test_offset_by_a_board_is_as_uncertain_as_its_distance() -> None:
    short = read_as(bare() - 0.003)
    one, two = (fit_with_board_distance(short, 0.2, n * BOARD_STD_M).offset_std_m for n in (1, 2))

    assert two == pytest.approx(2.0 * one, rel=0.01)
    assert one == pytest.approx(BOARD_STD_M, rel=0.5)


@pytest.mark.parametrize("board_m", [0.19, 0.21, 0.2 + 1.5 * MAX_OFFSET_M])
def test_board_at_another_distance_than_a_flat_wall_gives_none(board_m: float) -> None:
    assert fit_with_board_distance(read_as(bare()), board_m, BOARD_STD_M) is None


def test_board_distance_gives_no_offset_too_large_to_correct() -> None:
    far_off = read_as(bare() - 1.5 * MAX_OFFSET_M)
    assert fit_with_board_distance(far_off, 0.2, BOARD_STD_M) is None
