import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.flatness import Ripples, block_sums, ripples
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.noise import MeanNoise, depth_noise_m
from nlos_calibration.plane import PlaneFit, fit_depth
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import wall_depth

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
RAYS = PINHOLE.rays()
COLUMN = np.broadcast_to(np.arange(160), (120, 160))
ROW = np.broadcast_to(np.arange(120)[:, np.newaxis], (120, 160))
WALL_M = wall_depth(wall_from_plane(normal_from_angles(np.radians(20.0), 0.1), 0.2), PINHOLE)


def fitted(extra_m: Float64 | float, *, noise: float = 1.0, seed: int = 0) -> PlaneFit:
    """The plane of a mean over 25 frames, with some depth of the lidar's own."""
    deviates = np.random.default_rng(seed).standard_normal(WALL_M.shape)
    noisy_m = WALL_M + extra_m + noise * depth_noise_m(WALL_M) * deviates / 5
    told = MeanNoise(np.full(WALL_M.size, 25.0))
    return fit_depth(RAYS.reshape(-1, 3), noisy_m.ravel(), np.random.default_rng(0), told)


def judged(extra_m: Float64 | float, *, noise: float = 1.0, seed: int = 0) -> Ripples:
    return ripples(fitted(extra_m, noise=noise, seed=seed), RAYS)


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
def test_noise_is_no_ripple(noise: float) -> None:
    found = judged(0.0, noise=noise)
    assert found.rms_m < 5e-5 * noise
    assert found.correlation == 1.0
    np.testing.assert_array_equal(found.covariance, fitted(0.0, noise=noise).covariance)


def test_independent_noise_is_rarely_taken_for_ripples() -> None:
    assert np.mean([judged(0.0, seed=seed).correlation > 1.0 for seed in range(60)]) <= 0.05


@pytest.mark.parametrize("amplitude_m", [0.0005, 0.0015])
def test_ripples_are_told_by_their_size_and_the_covariance_grows(amplitude_m: float) -> None:
    wave_m = amplitude_m * np.sin(2.0 * np.pi * COLUMN / 27.0)
    found = judged(wave_m)
    assert found.rms_m == pytest.approx(amplitude_m / np.sqrt(2.0), rel=0.15)  # the wall is nearly square
    assert found.correlation > 10.0
    grown = np.linalg.eigvalsh(found.covariance - found.correlation * fitted(wave_m).covariance)
    assert grown.min() > -1e-9 * np.abs(found.covariance).max()


def test_the_covariance_is_that_of_what_drift_does_to_the_plane() -> None:
    """Drift in 12 x 9 patches, drawn 80 times: independent residuals would promise a tenth of the variance."""
    truth = fitted(0.0, noise=0.0).slopes
    grown, plain = [], []
    for seed in range(80):
        patches = np.random.default_rng(seed).standard_normal((9, 12))
        plane = fitted(0.0006 * np.kron(patches, np.ones((14, 14)))[:120, :160], seed=seed)
        off = plane.slopes - truth
        grown.append(off @ np.linalg.solve(ripples(plane, RAYS).covariance, off) / 3.0)
        plain.append(off @ np.linalg.solve(plane.covariance, off) / 3.0)
    assert np.mean(plain) > 10.0
    assert 0.5 < np.mean(grown) < 1.5


def test_noise_without_neighbours_is_no_ripple_however_large() -> None:
    found = judged(0.0006 * (-1.0) ** (COLUMN + ROW))
    assert found.correlation == 1.0
    assert found.rms_m < 1e-4


def test_exact_depth_has_no_ripples() -> None:
    exact = fit_depth(RAYS.reshape(-1, 3), WALL_M.ravel(), np.random.default_rng(0))
    found = ripples(exact, RAYS)
    assert found.rms_m < 1e-9
    assert np.isfinite(found.covariance).all()


def test_block_sums_hold_all_that_is_there() -> None:
    values = np.arange(35.0).reshape(5, 7)
    sums = block_sums(values, 3)
    assert sums.shape == (2, 3)
    assert sums.sum() == values.sum()
    assert sums[0, 0] == values[:3, :3].sum()
    assert sums[1, 2] == values[3:, 6:].sum()
