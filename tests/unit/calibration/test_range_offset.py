import numpy as np
import pytest
from nlos_calibration import WallFit, depth_noise_m, fit_wall, load_rig, normal_from_angles, wall_depth, wall_from_plane
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import CalibrationError
from nlos_calibration.range_offset import TAPE_STD_M, FitWith, fit_with_tape_distance

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)


def pose(distance_m: float, yaw_deg: float) -> Float64:
    return wall_from_plane(normal_from_angles(np.radians(yaw_deg), 0.05), distance_m)


def seen(depth_m: Float64) -> FitWith:
    """Return the wall fit, by offset, of a lidar that reads `depth_m` with a fifth of one sample's noise."""
    noisy_m = depth_m + 0.2 * depth_noise_m(depth_m) * np.random.default_rng(0).standard_normal(depth_m.shape)

    def fit_with(offset_m: float, origin_m: float) -> WallFit:
        return fit_wall(noisy_m + offset_m, PINHOLE, np.random.default_rng(0), origin_m=origin_m)

    return fit_with


def bare(distance_m: float, yaw_deg: float) -> Float64:
    depth_m = wall_depth(pose(distance_m, yaw_deg), PINHOLE)
    return np.where(depth_m < 4.0, depth_m, np.nan)


@pytest.mark.parametrize("offset_m", [-0.0045, 0.003])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0, 65.0])
def test_tape_offset_is_added_to_depth_that_is_too_short(yaw_deg: float, offset_m: float) -> None:
    """The beams meet at the front glass and every depth lacks the offset: the corrected pose is the true one."""
    taped = fit_with_tape_distance(seen(bare(0.2, yaw_deg) - offset_m), 0.2)
    assert taped.cause == "depth"
    assert taped.offset_m == pytest.approx(offset_m, abs=3e-5)
    np.testing.assert_allclose(taped.fit.wall_from_lidar, pose(0.2, yaw_deg), atol=3e-4)
    assert taped.fit.verdict == "good"


@pytest.mark.parametrize("offset_m", [-0.0045, 0.0045])
@pytest.mark.parametrize("yaw_deg", [20.0, 45.0, 65.0])
def test_tape_offset_of_the_origin_moves_the_pose_along_the_axis(yaw_deg: float, offset_m: float) -> None:
    """Depth is right, but its zero lies offset_m nearer to the wall than the front glass."""
    true = pose(0.2, yaw_deg)
    cosine = -true[2, 2]
    taped = fit_with_tape_distance(seen(bare(0.2, yaw_deg)), 0.2 + offset_m * cosine)
    assert taped.cause == "origin"
    assert taped.offset_m == pytest.approx(offset_m, abs=3e-5)
    assert taped.fit.distance_m == pytest.approx(0.2 + offset_m * cosine, abs=1e-9)
    assert taped.fit.wall_from_lidar[2, 3] == taped.fit.distance_m
    np.testing.assert_allclose(taped.fit.wall_from_lidar[:3, :3], true[:3, :3], atol=3e-4)


def test_tape_that_agrees_changes_only_the_uncertainty() -> None:
    fit_with = seen(bare(0.2, 45.0))
    plain = fit_with(0.0, 0.0)
    taped = fit_with_tape_distance(fit_with, plain.distance_m)
    assert taped.offset_m == 0.0
    np.testing.assert_array_equal(taped.fit.wall_from_lidar, plain.wall_from_lidar)
    assert taped.fit.distance_std_m == TAPE_STD_M


def test_tape_offset_is_less_certain_on_an_oblique_wall() -> None:
    squarely, obliquely = (fit_with_tape_distance(seen(bare(0.2, yaw_deg)), 0.201) for yaw_deg in (20.0, 65.0))
    assert squarely.offset_std_m == pytest.approx(TAPE_STD_M / np.cos(np.radians(20.0)), rel=0.02)
    assert obliquely.offset_std_m > 1.5 * squarely.offset_std_m


@pytest.mark.parametrize("tape_m", [0.1, 0.3])
def test_tape_far_from_the_measured_distance_is_refused(tape_m: float) -> None:
    with pytest.raises(CalibrationError, match=f"{1e3 * tape_m:.1f} mm"):
        fit_with_tape_distance(seen(bare(0.2, 45.0)), tape_m)
