from typing import Any

import numpy as np
import pytest
from nlos_calibration import MeanNoise, depth_noise_m, load_rig
from nlos_calibration.arrays import Float64
from nlos_calibration.flatness import Flatness, Ripples, flatness, ripples
from nlos_calibration.plane import PlaneFit, fit_depth

from nlos_cam.calibrate import view

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
RAYS = PINHOLE.rays()
COLUMN = np.broadcast_to(np.arange(160), (120, 160))
ROW = np.broadcast_to(np.arange(120)[:, np.newaxis], (120, 160))
WALL_M = view(0.2, 20.0, 6.0, PINHOLE).depth_m


def wall(yaw_deg: float = 20.0) -> Float64:
    return view(0.2, yaw_deg, 6.0, PINHOLE).depth_m


def fitted(depth_m: Float64, *, noise: float = 1.0, seed: int = 0) -> PlaneFit:
    """The plane of a mean over 25 frames."""
    noisy_m = depth_m + noise * depth_noise_m(WALL_M) * np.random.default_rng(seed).standard_normal(depth_m.shape) / 5
    samples = MeanNoise(np.full(depth_m.size, 25.0))
    return fit_depth(RAYS.reshape(-1, 3), noisy_m.ravel(), np.random.default_rng(0), samples)


def judged(depth_m: Float64, **how: Any) -> Flatness:
    return flatness(fitted(depth_m, **how), RAYS)


def rippled(extra_m: Float64 | float, **how: Any) -> Ripples:
    return ripples(fitted(WALL_M + extra_m, **how), RAYS)


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0])
def test_flatness_of_noise_has_no_bend(yaw_deg: float, noise: float) -> None:
    flat = judged(wall(yaw_deg), noise=noise)
    assert flat.bend_m < 5.0 * flat.bend_std_m
    assert flat.bend_deg < 5.0 * flat.bend_std_deg < 0.4


def test_flatness_bend_is_the_angle_that_each_side_turns() -> None:
    """Two walls that meet in the middle of the view, 2 degrees apart: each is 1 degree off the mean."""
    middle = 80
    slope = np.tan(np.radians(2.0)) * (np.maximum(COLUMN - middle, 0) / PINHOLE.fx) * 0.2
    flat = judged(wall() + slope)
    assert flat.bend_deg == pytest.approx(1.0, abs=0.35)
    assert flat.bend_deg > 10.0 * flat.bend_std_deg


@pytest.mark.parametrize("offset_m", [-0.0045, 0.002, 0.0045])
def test_flatness_finds_a_range_offset_on_an_oblique_wall(offset_m: float) -> None:
    flat = judged(wall(50.0) - offset_m)
    assert flat.offset_m == pytest.approx(offset_m, rel=0.1)
    assert abs(judged(wall(50.0)).offset_m) < 1e-4
    assert flat.bend_deg > 3.0 * flat.offset_bend_deg


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
def test_ripples_of_noise_are_none(noise: float) -> None:
    found = rippled(0.0, noise=noise)
    assert found.rms_m < 5e-5 * noise
    assert found.correlation == 1.0
    np.testing.assert_array_equal(found.covariance, fitted(WALL_M, noise=noise).covariance)


@pytest.mark.slow
def test_ripples_are_rarely_found_in_independent_noise() -> None:
    assert np.mean([rippled(0.0, seed=seed).correlation > 1.0 for seed in range(60)]) <= 0.05


@pytest.mark.parametrize("amplitude_m", [0.0005, 0.0015])
def test_ripples_have_their_size_and_widen_the_covariance(amplitude_m: float) -> None:
    wave_m = amplitude_m * np.sin(2.0 * np.pi * COLUMN / 27.0)
    found = rippled(wave_m)
    assert found.rms_m == pytest.approx(amplitude_m / np.sqrt(2.0), rel=0.15)  # the wall is nearly faced squarely
    assert found.correlation > 10.0
    grown = np.linalg.eigvalsh(found.covariance - found.correlation * fitted(WALL_M + wave_m).covariance)
    assert grown.min() > -1e-9 * np.abs(found.covariance).max()


def test_ripples_need_neighbours_that_agree() -> None:
    found = rippled(0.0006 * (-1.0) ** (COLUMN + ROW))
    assert found.correlation == 1.0
    assert found.rms_m < 1e-4
    exact = ripples(fit_depth(RAYS.reshape(-1, 3), WALL_M.ravel(), np.random.default_rng(0)), RAYS)
    assert exact.rms_m < 1e-9
    assert np.isfinite(exact.covariance).all()
