import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.noise import FIRST_FRAMES, DepthMean, depth_noise_m


def mean_of(frames: Float64) -> DepthMean:
    mean = DepthMean(*frames.shape[1:])
    for frame in frames:
        mean.add(frame)
    return mean


def test_the_mean_takes_only_returns() -> None:
    mean = mean_of(np.array([[[1.0, np.nan, np.inf, 0.0]], [[1.002, 2.0, np.inf, -1.0]]], np.float32))
    np.testing.assert_allclose(mean.mean_m(), [[1.001, 2.0, np.nan, np.nan]], rtol=1e-6)
    np.testing.assert_array_equal(mean.count(), [[2, 1, 0, 0]])
    assert mean.frames == 2


@pytest.mark.parametrize("count", [1, 2, FIRST_FRAMES - 1, FIRST_FRAMES, 40])
def test_mean_and_spread_are_those_of_the_frames(count: int) -> None:
    frames = np.random.default_rng(0).normal(0.2, 0.0009, (count, 3, 4))
    mean = mean_of(frames)
    np.testing.assert_allclose(mean.mean_m(), frames.mean(axis=0), rtol=1e-12)
    if count > 1:
        np.testing.assert_allclose(mean.spread_m(), frames.std(axis=0, ddof=1), rtol=1e-9)
    else:
        assert np.isnan(mean.spread_m()).all()


def test_looking_at_the_mean_does_not_change_it() -> None:
    frames = np.random.default_rng(0).normal(0.2, 0.0009, (12, 3, 4))
    looked = DepthMean(3, 4)
    for frame in frames:
        looked.add(frame)
        looked.mean_m()
    np.testing.assert_allclose(looked.mean_m(), frames.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(looked.spread_m(), frames.std(axis=0, ddof=1), rtol=1e-9)


def test_the_frames_are_not_changed() -> None:
    frame = np.array([[0.2, 0.0, np.nan]])
    DepthMean(1, 3).add(frame)
    np.testing.assert_array_equal(frame, [[0.2, 0.0, np.nan]])


def test_a_pixel_that_mostly_fails_has_no_mean() -> None:
    assert np.isnan(mean_of(np.array([[[0.2]], [[np.nan]], [[np.nan]]])).mean_m()).all()


def test_flicker_is_not_counted() -> None:
    frames = np.random.default_rng(1).normal(0.2, 0.0009, (60, 20, 20))
    steady = mean_of(frames).mean_m()
    stray = np.random.default_rng(2).random(frames.shape) < 0.1
    flickering = mean_of(np.where(stray, 1.0, frames))
    settled = np.abs(flickering.mean_m() - steady) < 0.0005  # but where the first frames mostly strayed
    assert settled.mean() > 0.98
    assert flickering.count()[settled].mean() == pytest.approx(54.0, abs=0.5)


def test_the_mean_of_no_frames_is_no_depth() -> None:
    assert np.isnan(DepthMean(2, 2).mean_m()).all()
    assert not DepthMean(2, 2).noise().measured


def test_the_noise_is_measured_by_the_spread() -> None:
    depth_m = np.broadcast_to(np.linspace(0.15, 2.0, 100), (30, 40, 100))
    frames = depth_m + 1.7 * depth_noise_m(depth_m) * np.random.default_rng(0).standard_normal(depth_m.shape)
    noise = mean_of(frames).noise()
    assert noise.measured
    assert noise.scale == pytest.approx(1.7, rel=0.02)
    np.testing.assert_array_equal(noise.samples, 30.0)
