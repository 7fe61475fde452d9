"""The bias of the depth: patterns that stay, drift that follows the temperature, nothing where there is none."""

import numpy as np
import pytest

from nlos_cam.render.sensor.bias import BIASES, DepthBias, ripples, smooth_patches
from nlos_cam.render.sensor.effects import sensor_effects
from nlos_cam.render.sensor.model import STEADY_CELSIUS, SensorModel, WarmUp

SHAPE = 120, 160
WARM_UP = WarmUp(from_celsius=25, to_celsius=45, time_constant_s=600)


def _bias_m(celsius: float | None, **fields: float | WarmUp) -> np.ndarray:
    model = SensorModel.model_validate(fields)
    return DepthBias(SHAPE, model, sensor_effects(model)).at_m(celsius)


def test_a_model_without_bias_has_none_at_any_temperature() -> None:
    for celsius in (None, 0.0, 100.0):
        assert _bias_m(celsius).size == _bias_m(celsius, warm_up=WARM_UP).size == 0


def test_the_true_depth_is_the_lidars_and_the_offset() -> None:
    np.testing.assert_allclose(_bias_m(None, range_offset_m=0.0045), np.full(SHAPE[0] * SHAPE[1], -0.0045), rtol=1e-6)


def test_ripples_are_a_wave_of_their_amplitude_with_several_periods_in_view() -> None:
    wave_m = _bias_m(None, ripple_m=0.002).reshape(SHAPE)
    assert np.abs(wave_m).max() == pytest.approx(0.002, rel=0.01)
    assert abs(wave_m.mean()) < 0.1 * 0.002
    power = np.abs(np.fft.rfft2(wave_m)) ** 2
    rows, columns = np.divmod(int(power.argmax()), power.shape[1])
    periods = np.hypot(min(rows, SHAPE[0] - rows) * SHAPE[1] / SHAPE[0], columns)
    assert periods == pytest.approx(5.0, abs=1.0)


def test_a_ripple_runs_any_way_and_any_phase() -> None:
    waves = [ripples(SHAPE, 4.0, np.random.default_rng(seed)) for seed in range(8)]
    alike = np.corrcoef([wave.ravel() for wave in waves]) - np.eye(8)
    assert np.abs(alike).max() < 0.9


def test_patches_are_smooth_and_of_unit_spread() -> None:
    pattern = smooth_patches(SHAPE, np.random.default_rng(0))
    assert pattern.std() == pytest.approx(1.0)
    assert np.abs(np.diff(pattern)).max() < 0.5
    few, many = (smooth_patches(SHAPE, np.random.default_rng(0), across) for across in (4, 24))
    assert np.diff(few).std() < np.diff(many).std() / 2


def test_patches_grow_from_nothing_to_their_spread_and_stay_where_they_are() -> None:
    cold, half, warm = (_bias_m(celsius, patch_drift_m=0.001, warm_up=WARM_UP) for celsius in (25.0, 35.0, 45.0))
    assert not cold.any()
    assert warm.std() == pytest.approx(0.001, rel=1e-4)
    assert warm.mean() == pytest.approx(0.0, abs=1e-7)  # what moves the whole view is the drift
    np.testing.assert_allclose(half, warm / 2, rtol=1e-5)
    np.testing.assert_array_equal(_bias_m(None, patch_drift_m=0.001), warm)


def test_drift_is_told_against_the_warm_device() -> None:
    for celsius, shift_m in ((45.0, 0.0), (None, 0.0), (35.0, -0.002), (25.0, -0.004)):
        drift_m = _bias_m(celsius, drift_m_per_celsius=0.0002, warm_up=WARM_UP)
        np.testing.assert_allclose(drift_m, shift_m, rtol=1e-6)


def test_all_of_it_adds_up() -> None:
    fields = {"range_offset_m": 0.0045, "ripple_m": 0.002, "patch_drift_m": 0.001, "drift_m_per_celsius": 0.0002}
    assert set(fields) == set(BIASES.values())
    alone = [_bias_m(30.0, **{name: value}, warm_up=WARM_UP) for name, value in fields.items()]
    np.testing.assert_allclose(_bias_m(30.0, **fields, warm_up=WARM_UP), np.sum(alone, axis=0), atol=1e-8)


def test_a_device_is_the_same_at_the_same_temperature() -> None:
    fields = {"ripple_m": 0.002, "patch_drift_m": 0.001}
    one, other = (_bias_m(STEADY_CELSIUS, **fields, warm_up=WARM_UP) for _ in range(2))
    np.testing.assert_array_equal(one, other)
