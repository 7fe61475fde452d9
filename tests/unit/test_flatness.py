import numpy as np
import pytest
from nlos_calibration.flatness import Flatness, block_sums, flatness
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.plane import fit_depth
from nlos_calibration.range_noise import MeanNoise, depth_noise_m
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import wall_depth
from numpy.typing import NDArray

Array = NDArray[np.float64]

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
RAYS = PINHOLE.rays()
COLUMN = np.broadcast_to(np.arange(160), (120, 160))
ROW = np.broadcast_to(np.arange(120)[:, np.newaxis], (120, 160))


def wall(yaw_deg: float = 20.0) -> Array:
    return wall_depth(wall_from_plane(normal_from_angles(np.radians(yaw_deg), 0.1), 0.2), PINHOLE)


def judged(depth_m: Array, *, noise: float = 1.0, samples: float = 25.0, seed: int = 0) -> Flatness:
    noisy_m = depth_m + noise * depth_noise_m(depth_m) * np.random.default_rng(seed).standard_normal(depth_m.shape) / 5
    told = MeanNoise(np.full(depth_m.size, samples), 1.0)
    return flatness(fit_depth(RAYS.reshape(-1, 3), noisy_m.ravel(), np.random.default_rng(0), told), RAYS)


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0])
def test_noise_is_neither_bend_nor_ripple(yaw_deg: float, noise: float) -> None:
    flat = judged(wall(yaw_deg), noise=noise)
    assert flat.bend_m < 5.0 * flat.bend_std_m
    assert flat.bend_deg < 5.0 * flat.bend_std_deg < 0.4
    assert flat.ripple_m < 5e-5 * noise
    assert flat.correlation == 1.0


def test_independent_noise_is_rarely_taken_for_ripples() -> None:
    grown = [judged(wall(), seed=seed).correlation > 1.0 for seed in range(60)]
    assert np.mean(grown) <= 0.05


def test_a_bend_is_told_by_how_much_each_side_turns() -> None:
    """Two walls that meet in the middle of the view, 2 degrees apart: each is 1 degree off the mean."""
    middle = 80
    slope = np.tan(np.radians(2.0)) * (np.maximum(COLUMN - middle, 0) / PINHOLE.fx) * 0.2
    flat = judged(wall() + slope)
    assert flat.bend_deg == pytest.approx(1.0, abs=0.35)
    assert flat.bend_deg > 10.0 * flat.bend_std_deg


@pytest.mark.parametrize("across", [COLUMN, ROW, COLUMN + ROW, COLUMN - ROW])
def test_a_step_is_found_whichever_way_it_runs(across: Array) -> None:
    flat = judged(wall() - 0.002 * (across > np.median(across)))
    assert flat.bend_deg > 0.4


@pytest.mark.parametrize("offset_m", [-0.0045, 0.002, 0.0045])
def test_an_offset_of_the_range_is_found_on_an_oblique_wall(offset_m: float) -> None:
    flat = judged(wall(50.0) - offset_m)
    assert flat.offset_m == pytest.approx(offset_m, rel=0.1)
    assert flat.bend_deg > 3.0 * flat.offset_bend_deg


def test_a_flat_wall_has_no_offset() -> None:
    assert abs(judged(wall(50.0)).offset_m) < 1e-4


@pytest.mark.parametrize("amplitude_m", [0.0005, 0.0015])
def test_ripples_are_told_by_their_size_and_the_covariance_grows(amplitude_m: float) -> None:
    wave = amplitude_m * np.sin(2.0 * np.pi * COLUMN / 27.0)
    flat = judged(wall() + wave)
    assert flat.ripple_m == pytest.approx(amplitude_m / np.sqrt(2.0), rel=0.15)  # the wall is nearly square
    assert flat.correlation > 10.0
    assert flat.bend_deg < 0.3 * amplitude_m / 0.001


def test_noise_without_neighbours_is_no_ripple_however_large() -> None:
    chess = 0.0006 * (-1.0) ** (COLUMN + ROW)
    flat = judged(wall() + chess)
    assert flat.correlation == 1.0
    assert flat.ripple_m < 1e-4


def test_block_sums_hold_all_that_is_there() -> None:
    values = np.arange(35.0).reshape(5, 7)
    sums = block_sums(values, 3)
    assert sums.shape == (2, 3)
    assert sums.sum() == values.sum()
    assert sums[0, 0] == values[:3, :3].sum()
    assert sums[1, 2] == values[3:, 6:].sum()
