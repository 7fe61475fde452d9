import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.noise import FIRST_FRAMES, QUANTUM_M, DepthMean, MeanNoise, depth_noise_m, measured_noise


def test_mean_noise_falls_with_the_root_of_the_samples() -> None:
    depth_m = np.array([0.2, 1.0])
    one, many = MeanNoise().of(depth_m), MeanNoise(np.array([25.0, 100.0])).of(depth_m)
    np.testing.assert_allclose(one / many, [5.0, 10.0])
    np.testing.assert_allclose(depth_noise_m(np.array([0.0, 1.0])), [0.0005, 0.0025])


@pytest.mark.parametrize("scale", [0.0, 0.15, 0.25, 0.5, 1.0])
def test_mean_noise_of_rounded_samples_matches_their_spread(scale: float) -> None:
    """Means of many rounded samples, at depths spread evenly between the quantization steps."""
    generator, samples = np.random.default_rng(0), 2000
    depth_m = generator.uniform(0.0, QUANTUM_M, (1, 500))
    rounded_m = np.round((depth_m + scale * 0.0005 * generator.standard_normal((samples, 500))) / QUANTUM_M) * QUANTUM_M
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
    spread_m = scale * depth_noise_m(depth_m) * np.sqrt((generator.standard_normal(shape) ** 2).mean(axis=0))
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
    mean = mean_of(np.array([[[1.0, np.nan, np.inf, 0.0]], [[1.002, 2.0, np.inf, -1.0]]], np.float32))
    np.testing.assert_allclose(mean.mean_m(), [[1.001, 2.0, np.nan, np.nan]], rtol=1e-6)
    np.testing.assert_array_equal(mean.count(), [[2, 1, 0, 0]])
    assert mean.frames == 2


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


def test_depth_mean_without_enough_returns_is_nan() -> None:
    assert np.isnan(mean_of(np.array([[[0.2]], [[np.nan]], [[np.nan]]])).mean_m()).all()
    assert np.isnan(DepthMean(2, 2).mean_m()).all()
    assert not DepthMean(2, 2).noise().measured


def test_depth_mean_leaves_out_flicker() -> None:
    frames = np.random.default_rng(1).normal(0.2, 0.0009, (60, 20, 20))
    steady = mean_of(frames).mean_m()
    stray = np.random.default_rng(2).random(frames.shape) < 0.1
    flickering = mean_of(np.where(stray, 1.0, frames))
    settled = np.abs(flickering.mean_m() - steady) < 0.0005  # but where the first frames mostly strayed
    assert settled.mean() > 0.98
    assert flickering.count()[settled].mean() == pytest.approx(54.0, abs=0.5)


def test_depth_mean_measures_the_noise_by_the_spread() -> None:
    depth_m = np.broadcast_to(np.linspace(0.15, 2.0, 100), (30, 40, 100))
    frames = depth_m + 1.7 * depth_noise_m(depth_m) * np.random.default_rng(0).standard_normal(depth_m.shape)
    noise = mean_of(frames).noise()
    assert noise.measured
    assert noise.scale == pytest.approx(1.7, rel=0.02)
    np.testing.assert_array_equal(noise.samples, 30.0)
