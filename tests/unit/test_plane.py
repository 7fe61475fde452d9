import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import normal_from_angles
from nlos_calibration.noise import MeanNoise, depth_noise_m
from nlos_calibration.plane import MIN_POINTS, fit_depth, fit_plane


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(7)


def wall_points(generator: np.random.Generator, count: int = 2000, *, noise: float = 1.0) -> tuple[Float64, Float64]:
    """Points (count, 3) on a wall 0.2 m away under random rays of the lidar's field, and the wall's normal."""
    normal = normal_from_angles(np.radians(40.0), np.radians(5.0))
    rays = np.column_stack([generator.uniform([-0.7, -0.52], [0.6, 0.52], (count, 2)), np.ones(count)])
    depth_m = 0.2 / -(rays @ normal)
    depth_m += noise * generator.standard_normal(count) * depth_noise_m(depth_m)
    return rays * depth_m[:, np.newaxis], normal


def angle_deg(a: Float64, b: Float64) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def test_an_exact_plane_is_found_exactly(generator: np.random.Generator) -> None:
    points, normal = wall_points(generator, noise=0.0)
    fit = fit_plane(points, generator)
    np.testing.assert_allclose(fit.normal, normal, atol=1e-9)
    assert fit.distance_m == pytest.approx(0.2, abs=1e-9)
    assert fit.inlier_fraction == 1.0
    assert fit.residual_m < 1e-9


def test_the_normal_is_a_unit_vector_towards_the_lidar(generator: np.random.Generator) -> None:
    fit = fit_plane(wall_points(generator)[0], generator)
    assert np.linalg.norm(fit.normal) == pytest.approx(1.0)
    assert fit.distance_m > 0.0


def test_the_residual_is_the_distance_of_the_inliers_from_the_plane(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator)
    points[::10] += [0.0, 0.0, 0.1]
    fit = fit_plane(points, generator)
    distances = points[fit.inliers] @ fit.normal + fit.distance_m
    assert fit.residual_m == pytest.approx(np.sqrt(np.mean(distances**2)))
    assert fit.inliers.mean() == pytest.approx(fit.inlier_fraction)
    assert not fit.inliers[::10].any()


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
def test_the_covariance_is_the_spread_of_what_is_measured(generator: np.random.Generator, noise: float) -> None:
    fits = [fit_plane(wall_points(generator, 1500, noise=noise)[0], generator) for _ in range(150)]
    truth = -wall_points(generator, 1)[1] / 0.2
    told = np.mean([fit.covariance for fit in fits], axis=0)
    # chi-square of 150 times 3 unknowns, and with it an error of the mean, were there a bias
    errors = np.array([fit.slopes for fit in fits]) - truth
    chi2 = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(told), errors)
    assert chi2.mean() / 3.0 == pytest.approx(1.0, abs=0.25)
    bias = errors.mean(axis=0)
    assert bias @ np.linalg.inv(told) @ bias * 150 < 16.0
    assert np.mean([fit.noise_scale for fit in fits]) == pytest.approx(noise, rel=0.05)


def test_many_samples_say_more_where_there_are_many(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator, 1000)
    one = fit_plane(points, generator, MeanNoise(np.full(1000, 4.0)))
    half = np.where(points[:, 0] > 0.0, 400.0, 4.0)
    both = fit_plane(points, generator, MeanNoise(half))
    assert one.noise_scale == pytest.approx(2.0, rel=0.1)  # the points are as noisy as single samples
    assert not np.allclose(both.slopes, one.slopes, rtol=1e-6)


def test_the_gate_closes_on_what_little_noise_is_left(generator: np.random.Generator) -> None:
    """Points 3 mm behind the wall pass for noise of a single sample, but not for that of a hundred."""
    points, normal = wall_points(generator, 4000, noise=0.1)
    away = generator.random(4000) < 0.1
    points[away] *= 1.0 + 0.003 / np.linalg.norm(points[away], axis=1)[:, np.newaxis]
    fit = fit_plane(points, generator, MeanNoise(np.full(4000, 100.0)))
    assert fit.inlier_fraction == pytest.approx(0.9, abs=0.03)
    assert fit.distance_m == pytest.approx(0.2, abs=2e-5)
    assert angle_deg(fit.normal, normal) < 0.02


def test_points_without_a_return_are_left_out(generator: np.random.Generator) -> None:
    points, normal = wall_points(generator)
    points[::3] = np.nan
    points[1::30] = -points[1::30]
    points[2::30, 0] = np.inf
    fit = fit_plane(points, generator)
    assert angle_deg(fit.normal, normal) < 0.2
    assert fit.inlier_fraction == 1.0
    assert not fit.inliers[::3].any()


@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_scattered_outliers_do_not_move_the_plane(generator: np.random.Generator, share: float) -> None:
    points, normal = wall_points(generator, 4000)
    stray = generator.random(len(points)) < share
    points[stray] *= generator.uniform(0.3, 4.0, (int(stray.sum()), 1))
    fit = fit_plane(points, generator)
    assert angle_deg(fit.normal, normal) < 0.2
    assert fit.distance_m == pytest.approx(0.2, abs=1e-3)
    assert fit.inlier_fraction == pytest.approx(1.0 - share, abs=0.05)


def test_sixty_percent_outliers_are_refused(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator)
    points[: int(0.6 * len(points))] *= generator.uniform(1.2, 4.0, (int(0.6 * len(points)), 1))
    with pytest.raises(WallRefusedError, match="lies on one plane"):
        fit_plane(points, generator)


@pytest.mark.parametrize("count", [0, 3, MIN_POINTS - 1])
def test_too_few_points_are_refused(generator: np.random.Generator, count: int) -> None:
    with pytest.raises(WallRefusedError, match=f"{count} points in front"):
        fit_plane(wall_points(generator, count)[0], generator)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -0.2, 1e-3])
def test_points_that_are_nowhere_in_front_are_refused(generator: np.random.Generator, value: float) -> None:
    with pytest.raises(WallRefusedError, match="0 points in front"):
        fit_plane(np.full((500, 3), value), generator)


def test_a_wall_behind_the_sensor_is_refused(generator: np.random.Generator) -> None:
    with pytest.raises(WallRefusedError, match="0 points in front"):
        fit_plane(-wall_points(generator)[0], generator)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("stray_share", [0.0, 0.2, 0.4])
def test_collinear_points_are_refused(generator: np.random.Generator, noise: float, stray_share: float) -> None:
    depth_m = np.linspace(0.2, 0.5, 1000)
    depth_m += noise * generator.standard_normal(1000) * depth_noise_m(depth_m)
    points = np.linspace(-0.5, 0.5, 1000)[:, np.newaxis] * [1.0, 0.3, 0.0] + [0.0, 0.05, 1.0]
    points *= depth_m[:, np.newaxis]
    stray = generator.random(1000) < stray_share
    points[stray] = wall_points(generator, 1000)[0][stray] * generator.uniform(0.3, 4.0, (int(stray.sum()), 1))
    with pytest.raises(WallRefusedError, match=r"in a line|lies on one plane"):
        fit_plane(points, generator)


def test_a_single_repeated_point_is_refused(generator: np.random.Generator) -> None:
    with pytest.raises(WallRefusedError, match="in a line"):
        fit_plane(np.tile([0.1, 0.0, 0.2], (500, 1)), generator)


def test_a_wall_seen_edge_on_is_refused(generator: np.random.Generator) -> None:
    in_plane = generator.uniform([-0.5, 0.2], [0.5, 1.0], (1000, 2))
    points = np.column_stack([0.1 * in_plane[:, 1], in_plane])  # the plane x = 0.1 z holds the lidar itself
    with pytest.raises(WallRefusedError, match="edge on"):
        fit_plane(points, generator)


def test_a_point_cloud_without_a_plane_is_refused(generator: np.random.Generator) -> None:
    with pytest.raises(WallRefusedError, match="lies on one plane"):
        fit_plane(generator.uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 1.0], (2000, 3)), generator)


def test_the_same_generator_gives_the_same_plane(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator)
    fits = [fit_plane(points, np.random.default_rng(3)) for _ in range(2)]
    np.testing.assert_array_equal(fits[0].normal, fits[1].normal)


def test_the_points_are_not_changed(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator)
    before = points.copy()
    fit_plane(points, generator)
    np.testing.assert_array_equal(points, before)


def test_a_narrow_strip_is_a_plane_where_the_caller_says_so(generator: np.random.Generator) -> None:
    normal = normal_from_angles(np.radians(40.0), 0.0)
    rays = np.column_stack([generator.uniform([0.55, -0.5], [0.6, 0.5], (3000, 2)), np.ones(3000)])
    depth_m = 0.2 / -(rays @ normal)
    with pytest.raises(WallRefusedError, match="seen in a line"):
        fit_depth(rays, depth_m, generator)
    assert angle_deg(fit_depth(rays, depth_m, generator, min_extent=0.02).normal, normal) < 1e-3
