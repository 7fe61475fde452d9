import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import normal_from_angles
from nlos_calibration.noise import (
    FIRST_FRAMES,
    QUANTUM_M,
    DepthMean,
    MeanNoise,
    depth_noise_m,
    measured_noise,
)
from nlos_calibration.plane import MIN_POINTS, PlaneFit, fit_depth


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(7)


def fit_plane(
    points_m: Float64, generator: np.random.Generator, noise: MeanNoise | None = None
) -> PlaneFit:
    depth_m = np.where(np.isfinite(points_m).all(axis=1), points_m[:, 2], np.nan)
    return fit_depth(
        points_m / np.where(depth_m > 0.0, depth_m, 1.0)[:, np.newaxis], depth_m, generator, noise
    )


def wall_points(
    generator: np.random.Generator, count: int = 2000, *, noise: float = 1.0
) -> tuple[Float64, Float64]:
    """Points (count, 3) on a wall 0.2 m away under random rays of the lidar's field, and the wall's
    normal.
    """
    normal = normal_from_angles(np.radians(40.0), np.radians(5.0))
    rays = np.column_stack(
        [generator.uniform([-0.7, -0.52], [0.6, 0.52], (count, 2)), np.ones(count)]
    )
    depth_m = 0.2 / -(rays @ normal)
    depth_m += noise * generator.standard_normal(count) * depth_noise_m(depth_m)
    return rays * depth_m[:, np.newaxis], normal


def angle_deg(a: Float64, b: Float64) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def test_fit_depth_residual_is_the_rms_distance_of_inliers(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator)
    points[::10] += [0.0, 0.0, 0.1]
    fit = fit_plane(points, generator)
    distances = points[fit.inliers] @ fit.normal + fit.distance_m
    assert fit.residual_m == pytest.approx(np.sqrt(np.mean(distances**2)))
    assert fit.inliers.mean() == pytest.approx(fit.inlier_fraction)
    assert not fit.inliers[::10].any()


def test_fit_depth_weighs_points_by_their_samples(generator: np.random.Generator) -> None:
    points, _ = wall_points(generator, 1000)
    one = fit_plane(points, generator, MeanNoise(np.full(1000, 4.0)))
    half = np.where(points[:, 0] > 0.0, 400.0, 4.0)
    both = fit_plane(points, generator, MeanNoise(half))
    assert one.noise_scale == pytest.approx(
        2.0, rel=0.1
    )  # the points are as noisy as single samples
    assert not np.allclose(both.slopes, one.slopes, rtol=1e-6)


def test_fit_depth_inlier_gate_follows_the_noise_of_the_mean(
    generator: np.random.Generator,
) -> None:
    """Points 3 mm behind the wall are within the noise of one sample, but not of a mean of a
    hundred.
    """
    points, normal = wall_points(generator, 4000, noise=0.1)
    away = generator.random(4000) < 0.1
    points[away] *= 1.0 + 0.003 / np.linalg.norm(points[away], axis=1)[:, np.newaxis]
    fit = fit_plane(points, generator, MeanNoise(np.full(4000, 100.0)))
    assert fit.inlier_fraction == pytest.approx(0.9, abs=0.03)
    assert fit.distance_m == pytest.approx(0.2, abs=2e-5)
    assert angle_deg(fit.normal, normal) < 0.02


@pytest.mark.parametrize("count", [0, 3, MIN_POINTS - 1])
def test_fit_depth_refuses_too_few_points(generator: np.random.Generator, count: int) -> None:
    with pytest.raises(WallRefusedError, match=f"{count} points"):
        fit_plane(wall_points(generator, count)[0], generator)
    for points in (
        -wall_points(generator, MIN_POINTS)[0],
        *(np.full((500, 3), x) for x in (np.nan, np.inf, 1e-3)),
    ):
        with pytest.raises(WallRefusedError, match="0 points"):
            fit_plane(points, generator)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("stray_share", [0.0, 0.2, 0.4])
def test_fit_depth_refuses_collinear_points(
    generator: np.random.Generator, noise: float, stray_share: float
) -> None:
    depth_m = np.linspace(0.2, 0.5, 1000)
    depth_m += noise * generator.standard_normal(1000) * depth_noise_m(depth_m)
    points = np.linspace(-0.5, 0.5, 1000)[:, np.newaxis] * [1.0, 0.3, 0.0] + [0.0, 0.05, 1.0]
    points *= depth_m[:, np.newaxis]
    stray = generator.random(1000) < stray_share
    points[stray] = wall_points(generator, 1000)[0][stray] * generator.uniform(
        0.3, 4.0, (int(stray.sum()), 1)
    )
    with pytest.raises(WallRefusedError):
        fit_plane(points, generator)


def test_fit_depth_refuses_what_is_no_plane(generator: np.random.Generator) -> None:
    in_plane = generator.uniform([-0.5, 0.2], [0.5, 1.0], (1000, 2))
    edge_on = np.column_stack([0.1 * in_plane[:, 1], in_plane])
    cloud = generator.uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 1.0], (2000, 3))
    for points, word in (
        (np.tile([0.1, 0.0, 0.2], (500, 1)), "line"),
        (edge_on, "edge on"),
        (cloud, "plane"),
    ):
        with pytest.raises(WallRefusedError, match=word):
            fit_plane(points, generator)


def test_fit_depth_accepts_a_narrow_strip_if_allowed(generator: np.random.Generator) -> None:
    normal = normal_from_angles(np.radians(40.0), 0.0)
    rays = np.column_stack([generator.uniform([0.55, -0.5], [0.6, 0.5], (3000, 2)), np.ones(3000)])
    depth_m = 0.2 / -(rays @ normal)
    with pytest.raises(WallRefusedError, match="line"):
        fit_depth(rays, depth_m, generator)
    assert angle_deg(fit_depth(rays, depth_m, generator, min_extent=0.02).normal, normal) < 1e-3


def test_mean_noise_falls_with_the_root_of_the_samples() -> None:
    depth_m = np.array([0.2, 1.0])
    one = MeanNoise().of(depth_m)
    many = MeanNoise(np.array([25.0, 100.0])).of(depth_m)
    np.testing.assert_allclose(one / many, [5.0, 10.0])
    np.testing.assert_allclose(depth_noise_m(np.array([0.0, 1.0])), [0.0005, 0.0025])


@pytest.mark.parametrize("scale", [0.0, 0.15, 0.25, 0.5, 1.0])
def test_mean_noise_of_rounded_samples_matches_their_spread(scale: float) -> None:
    """Means of many rounded samples, at depths spread evenly between the quantization steps."""
    generator = np.random.default_rng(0)
    samples = 2000
    depth_m = generator.uniform(0.0, QUANTUM_M, (1, 500))
    rounded_m = (
        np.round((depth_m + scale * 0.0005 * generator.standard_normal((samples, 500))) / QUANTUM_M)
        * QUANTUM_M
    )
    spread_m = float(np.std(rounded_m.mean(axis=0) - depth_m))
    # a sample's own rounding is part of what is measured as its noise
    measured = np.hypot(scale, 0.0 if scale < 0.2 else QUANTUM_M / np.sqrt(12) / 0.0005)
    told = MeanNoise(np.array([float(samples)]), scale).of(np.zeros(1))[0]
    assert spread_m == pytest.approx(told * (measured / scale if scale > 0.2 else 1.0), rel=0.25)


@pytest.mark.parametrize("samples", [4, 5, 10, 100])
@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_measured_noise_finds_the_scale_from_few_samples(samples: int, scale: float) -> None:
    generator = np.random.default_rng(3)
    depth_m = generator.uniform(0.15, 1.0, 20_000)
    shape = samples - 1, 20_000
    spread_m = (
        scale
        * depth_noise_m(depth_m)
        * np.sqrt((generator.standard_normal(shape) ** 2).mean(axis=0))
    )
    spread_m[:2000] = 0.3  # flickering points
    noise = measured_noise(depth_m, spread_m, np.full(20_000, samples))
    assert noise.measured
    assert noise.scale == pytest.approx(scale, rel=0.07)


def test_measured_noise_of_too_few_samples_is_nominal() -> None:
    noise = measured_noise(np.full(9, 0.2), np.full(9, 0.1), np.full(9, 3))
    assert (noise.scale, noise.measured) == (1.0, False)
    np.testing.assert_array_equal(noise.samples, 3.0)
    empty = measured_noise(np.full(9, np.nan), np.full(9, np.nan), np.zeros(9, np.int64))
    assert np.isfinite(empty.of(np.ones(9))).all()


def mean_of(frames: Float64) -> DepthMean:
    mean = DepthMean(*frames.shape[1:])
    for frame in frames:
        mean.add(frame)
    return mean


def test_depth_mean_counts_only_returns() -> None:
    mean = mean_of(
        np.array([[[1.0, np.nan, np.inf, 0.0]], [[1.002, 2.0, np.inf, -1.0]]], np.float32)
    )
    np.testing.assert_allclose(mean.mean_m(), [[1.001, 2.0, np.nan, np.nan]], rtol=1e-6)
    np.testing.assert_array_equal(mean.count(), [[2, 1, 0, 0]])
    assert mean.frames == 2
    for without in (mean_of(np.array([[[0.2]], [[np.nan]], [[np.nan]]])), DepthMean(2, 2)):
        assert np.isnan(without.mean_m()).all()
        assert not without.noise().measured


@pytest.mark.parametrize("count", [1, 2, FIRST_FRAMES - 1, FIRST_FRAMES, 40])
def test_depth_mean_and_spread_are_those_of_the_frames(count: int) -> None:
    frames = np.random.default_rng(0).normal(0.2, 0.0009, (count, 3, 4))
    mean = DepthMean(3, 4)
    for frame in frames:
        mean.add(frame)
        mean.mean_m()  # reading the mean changes nothing
    np.testing.assert_allclose(mean.mean_m(), frames.mean(axis=0), rtol=1e-12)
    if count > 1:
        np.testing.assert_allclose(mean.spread_m(), frames.std(axis=0, ddof=1), rtol=1e-9)
    else:
        assert np.isnan(mean.spread_m()).all()


def test_depth_mean_leaves_out_flicker() -> None:
    frames = np.random.default_rng(1).normal(0.2, 0.0009, (60, 20, 20))
    steady = mean_of(frames).mean_m()
    stray = np.random.default_rng(2).random(frames.shape) < 0.1
    flickering = mean_of(np.where(stray, 1.0, frames))
    settled = (
        np.abs(flickering.mean_m() - steady) < 0.0005
    )  # but where the first frames mostly strayed
    assert settled.mean() > 0.98
    assert flickering.count()[settled].mean() == pytest.approx(54.0, abs=0.5)


def test_depth_mean_measures_the_noise_by_the_spread() -> None:
    depth_m = np.broadcast_to(np.linspace(0.15, 2.0, 100), (30, 40, 100))
    frames = depth_m + 1.7 * depth_noise_m(depth_m) * np.random.default_rng(0).standard_normal(
        depth_m.shape
    )
    noise = mean_of(frames).noise()
    assert noise.measured
    assert noise.scale == pytest.approx(1.7, rel=0.02)
    np.testing.assert_array_equal(noise.samples, 30.0)
