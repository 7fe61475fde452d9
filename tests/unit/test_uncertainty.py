import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.geometry import normal_from_angles
from nlos_calibration.wall import WallMeasures, measures_of

SPREAD = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]])
"""The shape of a covariance; as large as the plane's slopes are uncertain."""


def slopes_of(distance_m: float, yaw_deg: float, pitch_deg: float) -> Float64:
    return -normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)) / distance_m


def drawn(slopes: Float64, covariance: Float64, count: int = 4000) -> list[WallMeasures]:
    some = np.random.default_rng(0).multivariate_normal(slopes, covariance, count)
    return [measures_of(one, covariance) for one in some]


@pytest.mark.parametrize("distance_m", [0.15, 0.3])
@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(45.0, 0.0), (-60.0, 10.0), (15.0, -12.0), (74.0, 3.0)])
def test_distance_and_angles_are_those_of_the_plane(distance_m: float, yaw_deg: float, pitch_deg: float) -> None:
    told = measures_of(slopes_of(distance_m, yaw_deg, pitch_deg), np.zeros((3, 3)))
    assert (told.distance_m, told.yaw_deg, told.pitch_deg) == pytest.approx((distance_m, yaw_deg, pitch_deg))
    assert np.cos(np.radians(told.facing_deg)) == pytest.approx(
        np.cos(np.radians(yaw_deg)) * np.cos(np.radians(pitch_deg))
    )
    assert (told.distance_std_m, told.yaw_std_deg, told.pitch_std_deg, told.facing_std_deg) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(45.0, 0.0), (-60.0, 10.0), (15.0, -12.0), (74.0, 3.0)])
def test_standard_uncertainties_are_the_spread_of_what_could_have_been_measured(
    yaw_deg: float, pitch_deg: float
) -> None:
    slopes, covariance = slopes_of(0.2, yaw_deg, pitch_deg), 1e-6 * SPREAD
    told, others = measures_of(slopes, covariance), drawn(slopes, covariance)
    for name in ("distance_m", "yaw_deg", "pitch_deg", "facing_deg"):
        stem, unit = name.rsplit("_", 1)
        spread = float(np.std([getattr(other, name) for other in others]))
        assert getattr(told, f"{stem}_std_{unit}") == pytest.approx(spread, rel=0.06), name


@pytest.mark.parametrize("facing_deg", [0.0, 0.02, 0.1, 0.3, 1.0, 5.0])
@pytest.mark.parametrize("shape", [np.eye(3), SPREAD])
def test_a_wall_faced_squarely_has_a_facing_angle_that_is_allowed_for(facing_deg: float, shape: Float64) -> None:
    """Near 0 the angle cannot be negative: what is measured is too large, and its interval must reach back to 0."""
    slopes, covariance = slopes_of(0.2, facing_deg, 0.0), 1e-4 * shape  # tenths of a degree
    inside = [abs(one.facing_deg - facing_deg) <= 1.96 * one.facing_std_deg for one in drawn(slopes, covariance)]
    assert 0.93 <= np.mean(inside) <= 0.99


def test_far_from_square_the_facing_angle_is_the_yaw() -> None:
    told = measures_of(slopes_of(0.2, 40.0, 0.0), 1e-6 * SPREAD)
    assert told.facing_std_deg == pytest.approx(told.yaw_std_deg, rel=1e-3)


def test_uncertainty_grows_with_the_noise() -> None:
    one, three = (measures_of(slopes_of(0.2, 40.0, 5.0), factor * 1e-6 * SPREAD) for factor in (1.0, 9.0))
    for name in ("distance_std_m", "yaw_std_deg", "pitch_std_deg", "facing_std_deg"):
        assert getattr(three, name) == pytest.approx(3.0 * getattr(one, name), rel=1e-6)
