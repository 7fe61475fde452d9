import numpy as np
import pytest
from nlos_calibration.noise import QUANTUM_M, MeanNoise, depth_noise_m, measured_noise


def test_noise_grows_with_depth() -> None:
    assert depth_noise_m(0.0) == 0.0005
    assert depth_noise_m(1.0) == 0.0025


def test_the_noise_of_a_mean_falls_with_the_root_of_the_samples() -> None:
    depth_m = np.array([0.2, 1.0])
    one, many = MeanNoise().of(depth_m), MeanNoise(np.array([25.0, 100.0])).of(depth_m)
    np.testing.assert_allclose(one / many, [5.0, 10.0])


@pytest.mark.parametrize("scale", [0.0, 0.15, 0.25, 0.5, 1.0])
def test_the_noise_of_a_mean_of_rounded_samples_is_what_it_is(scale: float) -> None:
    """Means over many rounded samples, of depths that lie anyhow between the steps."""
    generator, samples = np.random.default_rng(0), 2000
    depth_m = generator.uniform(0.0, QUANTUM_M, (1, 500))
    # at no depth the noise is its floor
    rounded_m = np.round((depth_m + scale * 0.0005 * generator.standard_normal((samples, 500))) / QUANTUM_M) * QUANTUM_M
    spread_m = float(np.std(rounded_m.mean(axis=0) - depth_m))
    # a sample's own rounding is part of what is measured as its noise
    measured = np.hypot(scale, 0.0 if scale < 0.2 else QUANTUM_M / np.sqrt(12) / 0.0005)
    told = MeanNoise(np.array([float(samples)]), scale).of(np.zeros(1))[0]
    assert spread_m == pytest.approx(told * (measured / scale if scale > 0.2 else 1.0), rel=0.25)


def test_some_points_have_their_own_samples() -> None:
    noise = MeanNoise(np.array([1.0, 4.0, 9.0]), 2.0, measured=True)
    some = noise.at(np.array([True, False, True]))
    np.testing.assert_array_equal(some.samples, [1.0, 9.0])
    assert (some.scale, some.measured) == (2.0, True)
    assert MeanNoise().at(slice(0, 7)) == MeanNoise().at(slice(None))


@pytest.mark.parametrize("samples", [4, 5, 10, 100])
@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_the_scale_is_found_from_few_samples_too(samples: int, scale: float) -> None:
    generator = np.random.default_rng(3)
    depth_m = generator.uniform(0.15, 1.0, 20_000)
    shape = samples - 1, 20_000
    spread_m = scale * depth_noise_m(depth_m) * np.sqrt((generator.standard_normal(shape) ** 2).mean(axis=0))
    spread_m[:2000] = 0.3  # flickering points
    noise = measured_noise(depth_m, spread_m, np.full(20_000, samples))
    assert noise.measured
    assert noise.scale == pytest.approx(scale, rel=0.07)


def test_too_few_samples_tell_nothing() -> None:
    noise = measured_noise(np.full(9, 0.2), np.full(9, 0.1), np.full(9, 3))
    assert (noise.scale, noise.measured) == (1.0, False)
    np.testing.assert_array_equal(noise.samples, 3.0)
    empty = measured_noise(np.full(9, np.nan), np.full(9, np.nan), np.zeros(9, np.int64))
    assert np.isfinite(empty.of(np.ones(9))).all()
