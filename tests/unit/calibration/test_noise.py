import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.noise import (
    FIRST_FRAMES,
    NOISE_FLOOR_M,
    QUANTUM_M,
    DepthMean,
    MeanNoise,
    depth_noise_m,
    measured_noise,
)


def test_depth_noise_grows_with_the_depth() -> None:
    np.testing.assert_allclose(depth_noise_m(np.array([0.0, 1.0])), [0.0005, 0.0025])


def test_mean_noise_falls_with_the_root_of_the_samples() -> None:
    depth_m = np.array([0.2, 1.0])
    one = MeanNoise().of(depth_m)
    many = MeanNoise(np.array([25.0, 100.0])).of(depth_m)

    np.testing.assert_allclose(one / many, [5.0, 10.0])


@pytest.mark.parametrize("scale", [0.0, 0.15, 0.25, 0.5, 1.0])
def test_mean_noise_of_rounded_samples_matches_their_spread(scale: float) -> None:
    """Means of many rounded samples, at depths spread evenly between the quantization steps."""
    generator = np.random.default_rng(0)
    samples = 2000
    depth_m = generator.uniform(0.0, QUANTUM_M, (1, 500))
    noisy_m = depth_m + scale * NOISE_FLOOR_M * generator.standard_normal((samples, 500))
    rounded_m = np.round(noisy_m / QUANTUM_M) * QUANTUM_M
    spread_m = float(np.std(rounded_m.mean(axis=0) - depth_m))

    expected_m = MeanNoise(np.array([float(samples)]), scale).of(np.zeros(1))[0]
    if scale > 0.2:
        # each sample's own rounding is noise too, which the scale here leaves out
        rounding = QUANTUM_M / np.sqrt(12) / NOISE_FLOOR_M
        expected_m *= np.hypot(scale, rounding) / scale

    assert spread_m == pytest.approx(expected_m, rel=0.25)


@pytest.mark.parametrize("samples", [4, 5, 10, 100])
@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_noise_scale_is_found_from_few_samples_and_flicker(samples: int, scale: float) -> None:
    generator = np.random.default_rng(3)
    depth_m = generator.uniform(0.15, 1.0, 20_000)
    squares = generator.standard_normal((samples - 1, 20_000)) ** 2
    spread_m = scale * depth_noise_m(depth_m) * np.sqrt(squares.mean(axis=0))
    flickering = slice(2000)
    spread_m[flickering] = 0.3
    noise = measured_noise(depth_m, spread_m, np.full(20_000, samples))

    assert noise.measured
    assert noise.scale == pytest.approx(scale, rel=0.07)


def test_noise_of_too_few_samples_is_nominal() -> None:
    noise = measured_noise(np.full(9, 0.2), np.full(9, 0.1), np.full(9, 3))

    assert noise.scale == 1.0
    assert not noise.measured
    np.testing.assert_array_equal(noise.samples, 3.0)


def test_noise_without_a_sample_is_finite() -> None:
    nothing = np.full(9, np.nan)
    noise = measured_noise(nothing, nothing, np.zeros(9, np.int64))

    assert np.isfinite(noise.of(np.ones(9))).all()


def mean_of(frames: Float64) -> DepthMean:
    mean = DepthMean(*frames.shape[1:])
    for frame in frames:
        mean.add(frame)
    return mean


def test_depth_mean_counts_only_returns() -> None:
    first = [[1.0, np.nan, np.inf, 0.0]]
    second = [[1.002, 2.0, np.inf, -1.0]]
    mean = mean_of(np.array([first, second], np.float32))

    np.testing.assert_allclose(mean.mean_m(), [[1.001, 2.0, np.nan, np.nan]], rtol=1e-6)
    np.testing.assert_array_equal(mean.count(), [[2, 1, 0, 0]])
    assert mean.frames == 2


@pytest.mark.parametrize("frames", [[0.2, np.nan, np.nan], []])
def test_depth_mean_needs_returns_in_half_of_the_frames(frames: list[float]) -> None:
    mean = mean_of(np.array(frames).reshape(-1, 1, 1))

    assert np.isnan(mean.mean_m()).all()
    assert not mean.noise().measured


@pytest.mark.parametrize("count", [1, 2, FIRST_FRAMES - 1, FIRST_FRAMES, 40])
def test_depth_mean_is_that_of_the_frames_also_if_read_between(count: int) -> None:
    frames = np.random.default_rng(0).normal(0.2, 0.0009, (count, 3, 4))
    mean = DepthMean(3, 4)
    for frame in frames:
        mean.add(frame)
        mean.mean_m()

    np.testing.assert_allclose(mean.mean_m(), frames.mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("count", [2, FIRST_FRAMES - 1, FIRST_FRAMES, 40])
def test_depth_spread_is_that_of_the_frames(count: int) -> None:
    frames = np.random.default_rng(0).normal(0.2, 0.0009, (count, 3, 4))
    spread_m = mean_of(frames).spread_m()

    np.testing.assert_allclose(spread_m, frames.std(axis=0, ddof=1), rtol=1e-9)


def test_depth_spread_of_one_frame_is_unknown() -> None:
    assert np.isnan(mean_of(np.full((1, 3, 4), 0.2)).spread_m()).all()


def test_depth_mean_leaves_out_flicker() -> None:
    frames = np.random.default_rng(1).normal(0.2, 0.0009, (60, 20, 20))
    steady_m = mean_of(frames).mean_m()
    stray = np.random.default_rng(2).random(frames.shape) < 0.1
    flickering = mean_of(np.where(stray, 1.0, frames))
    # where most of the first frames strayed, their median does
    settled = np.abs(flickering.mean_m() - steady_m) < 0.0005

    assert settled.mean() > 0.98
    assert flickering.count()[settled].mean() == pytest.approx(54.0, abs=0.5)


def test_depth_mean_measures_the_noise_by_the_spread() -> None:
    depth_m = np.broadcast_to(np.linspace(0.15, 2.0, 100), (30, 40, 100))
    errors = np.random.default_rng(0).standard_normal(depth_m.shape)
    noise = mean_of(depth_m + 1.7 * depth_noise_m(depth_m) * errors).noise()

    assert noise.measured
    assert noise.scale == pytest.approx(1.7, rel=0.02)
    np.testing.assert_array_equal(noise.samples, 30.0)
