import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import normal_from_angles
from nlos_calibration.noise import MeanNoise, depth_noise_m
from nlos_calibration.plane import MIN_POINTS, PlaneFit, fit_depth

Generator = np.random.Generator
NORMAL = normal_from_angles(np.radians(40.0), np.radians(5.0))
DISTANCE_M = 0.2


@pytest.fixture
def generator() -> Generator:
    return np.random.default_rng(7)


def fit_plane(points_m: Float64, generator: Generator, samples: Float64 | None = None) -> PlaneFit:
    """Fit points (n, 3); `samples` is the number of samples of each."""
    valid = np.isfinite(points_m).all(axis=1)
    depth_m = np.where(valid, points_m[:, 2], np.nan)
    rays = points_m / np.where(depth_m > 0.0, depth_m, 1.0)[:, np.newaxis]
    noise = None if samples is None else MeanNoise(samples)
    return fit_depth(rays, depth_m, generator, noise)


def wall_points(generator: Generator, count: int = 2000, *, noise: float = 1.0) -> Float64:
    """Return points (count, 3) of the wall under random rays of the lidar's field."""
    sides = generator.uniform([-0.7, -0.52], [0.6, 0.52], (count, 2))
    rays = np.column_stack([sides, np.ones(count)])
    depth_m = DISTANCE_M / -(rays @ NORMAL)
    depth_m += noise * generator.standard_normal(count) * depth_noise_m(depth_m)
    return rays * depth_m[:, np.newaxis]


def angle_deg(a: Float64, b: Float64) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def test_residual_is_the_rms_distance_of_inliers(generator: Generator) -> None:
    points = wall_points(generator)
    points[::10] += [0.0, 0.0, 0.1]
    fit = fit_plane(points, generator)
    off_m = points[fit.inliers] @ fit.normal + fit.distance_m

    assert fit.residual_m == pytest.approx(np.sqrt(np.mean(off_m**2)))


def test_points_off_the_plane_are_no_inliers(generator: Generator) -> None:
    points = wall_points(generator)
    points[::10] += [0.0, 0.0, 0.1]
    fit = fit_plane(points, generator)

    assert not fit.inliers[::10].any()
    assert fit.inlier_fraction == pytest.approx(fit.inliers.mean())


def test_noise_scale_is_that_of_the_residuals(generator: Generator) -> None:
    """The points are as noisy as single samples, and given as means of four."""
    points = wall_points(generator, 1000)
    fit = fit_plane(points, generator, np.full(1000, 4.0))

    assert fit.noise_scale == pytest.approx(2.0, rel=0.1)


def test_points_of_more_samples_weigh_more(generator: Generator) -> None:
    points = wall_points(generator, 1000)
    alike = fit_plane(points, generator, np.full(1000, 4.0))
    right = np.where(points[:, 0] > 0.0, 400.0, 4.0)
    weighted = fit_plane(points, generator, right)

    assert not np.allclose(weighted.slopes, alike.slopes, rtol=1e-6)


def test_gate_follows_the_noise_of_the_mean(generator: Generator) -> None:
    """Points 3 mm behind the wall are in the noise of one sample, but not of a mean of a hundred."""
    points = wall_points(generator, 4000, noise=0.1)
    away = generator.random(4000) < 0.1
    length_m = np.linalg.norm(points[away], axis=1)[:, np.newaxis]
    points[away] *= 1.0 + 0.003 / length_m
    fit = fit_plane(points, generator, np.full(4000, 100.0))

    assert fit.inlier_fraction == pytest.approx(0.9, abs=0.03)
    assert fit.distance_m == pytest.approx(DISTANCE_M, abs=2e-5)
    assert angle_deg(fit.normal, NORMAL) < 0.02


@pytest.mark.parametrize("count", [0, 3, MIN_POINTS - 1])
def test_too_few_points_are_refused(generator: Generator, count: int) -> None:
    with pytest.raises(WallRefusedError, match=f"{count} points"):
        fit_plane(wall_points(generator, count), generator)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e-3, -0.2])
def test_depth_without_a_return_is_no_point(generator: Generator, value: float) -> None:
    with pytest.raises(WallRefusedError, match="0 points"):
        fit_plane(np.full((500, 3), value), generator)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("stray_share", [0.0, 0.2, 0.4])
def test_points_in_a_line_are_refused(
    generator: Generator, noise: float, stray_share: float
) -> None:
    depth_m = np.linspace(0.2, 0.5, 1000)
    depth_m += noise * generator.standard_normal(1000) * depth_noise_m(depth_m)
    along = np.linspace(-0.5, 0.5, 1000)[:, np.newaxis]
    rays = along * [1.0, 0.3, 0.0] + [0.0, 0.05, 1.0]
    points = rays * depth_m[:, np.newaxis]

    stray = generator.random(1000) < stray_share
    factors = generator.uniform(0.3, 4.0, (int(stray.sum()), 1))
    points[stray] = wall_points(generator, 1000)[stray] * factors
    with pytest.raises(WallRefusedError):
        fit_plane(points, generator)


def test_one_point_many_times_is_refused(generator: Generator) -> None:
    with pytest.raises(WallRefusedError, match="line"):
        fit_plane(np.tile([0.1, 0.0, 0.2], (500, 1)), generator)


def test_wall_edge_on_is_refused(generator: Generator) -> None:
    y_z = generator.uniform([-0.5, 0.2], [0.5, 1.0], (1000, 2))
    edge_on = np.column_stack([0.1 * y_z[:, 1], y_z])
    with pytest.raises(WallRefusedError, match="edge on"):
        fit_plane(edge_on, generator)


def test_narrow_strip_is_accepted_only_if_allowed(generator: Generator) -> None:
    sides = generator.uniform([0.55, -0.5], [0.6, 0.5], (3000, 2))
    rays = np.column_stack([sides, np.ones(3000)])
    depth_m = DISTANCE_M / -(rays @ NORMAL)
    with pytest.raises(WallRefusedError, match="line"):
        fit_depth(rays, depth_m, generator)
    fit = fit_depth(rays, depth_m, generator, min_extent=0.02)

    assert angle_deg(fit.normal, NORMAL) < 1e-3
