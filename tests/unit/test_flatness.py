import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.flatness import Flatness, flatness
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.noise import MeanNoise, depth_noise_m
from nlos_calibration.plane import fit_depth
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import wall_depth

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
RAYS = PINHOLE.rays()
COLUMN = np.broadcast_to(np.arange(160), (120, 160))
ROW = np.broadcast_to(np.arange(120)[:, np.newaxis], (120, 160))


def wall(yaw_deg: float = 20.0) -> Float64:
    return wall_depth(wall_from_plane(normal_from_angles(np.radians(yaw_deg), 0.1), 0.2), PINHOLE)


def judged(depth_m: Float64, *, noise: float = 1.0, samples: float = 25.0, seed: int = 0) -> Flatness:
    noisy_m = depth_m + noise * depth_noise_m(depth_m) * np.random.default_rng(seed).standard_normal(depth_m.shape) / 5
    told = MeanNoise(np.full(depth_m.size, samples), 1.0)
    return flatness(fit_depth(RAYS.reshape(-1, 3), noisy_m.ravel(), np.random.default_rng(0), told), RAYS)


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0])
def test_noise_is_no_bend(yaw_deg: float, noise: float) -> None:
    flat = judged(wall(yaw_deg), noise=noise)
    assert flat.bend_m < 5.0 * flat.bend_std_m
    assert flat.bend_deg < 5.0 * flat.bend_std_deg < 0.4


def test_a_bend_is_told_by_how_much_each_side_turns() -> None:
    """Two walls that meet in the middle of the view, 2 degrees apart: each is 1 degree off the mean."""
    middle = 80
    slope = np.tan(np.radians(2.0)) * (np.maximum(COLUMN - middle, 0) / PINHOLE.fx) * 0.2
    flat = judged(wall() + slope)
    assert flat.bend_deg == pytest.approx(1.0, abs=0.35)
    assert flat.bend_deg > 10.0 * flat.bend_std_deg


@pytest.mark.parametrize("across", [COLUMN, ROW, COLUMN + ROW, COLUMN - ROW])
def test_a_step_is_found_whichever_way_it_runs(across: Float64) -> None:
    flat = judged(wall() - 0.002 * (across > np.median(across)))
    assert flat.bend_deg > 0.4


@pytest.mark.parametrize("offset_m", [-0.0045, 0.002, 0.0045])
def test_an_offset_of_the_range_is_found_on_an_oblique_wall(offset_m: float) -> None:
    flat = judged(wall(50.0) - offset_m)
    assert flat.offset_m == pytest.approx(offset_m, rel=0.1)
    assert flat.bend_deg > 3.0 * flat.offset_bend_deg


def test_a_flat_wall_has_no_offset() -> None:
    assert abs(judged(wall(50.0)).offset_m) < 1e-4
