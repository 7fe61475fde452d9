"""The sensor model: what it refuses, by the name of the field."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from nlos_cam.frames import SATURATED
from nlos_cam.render.sensor.model import STEADY_CELSIUS, SensorModel, WarmUp

MOST = {
    "pulse_ns": 100.0,
    "wall_texture": 1.0,
    "ambient_counts": 254.9,
    "range_noise_m": 10.0,
    "range_noise_per_m": 1.0,
    "read_noise_counts": 255.0,
    "shot_noise": 255.0,
    "dead_share": 0.99,
    "ripple_m": 1.0,
    "patch_drift_m": 1.0,
}


@pytest.mark.parametrize("field", MOST)
def test_each_field_has_its_limits(field: str) -> None:
    for value in (0.0, MOST[field]):
        assert getattr(SensorModel.model_validate({field: value}), field) == value
    for value in (-1e-9, 1.02 * MOST[field], float("nan"), float("inf")):
        with pytest.raises(ValidationError, match=field):
            SensorModel.model_validate({field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("bare_wall_counts", 0), ("bare_wall_counts", 2e6), ("ambient_counts", SATURATED), ("gain", 2)],
)
def test_a_model_that_cannot_be_names_its_field(field: str, value: float) -> None:
    with pytest.raises(ValidationError, match=field):
        SensorModel.model_validate({field: value})


def test_unless_asked_there_is_no_pulse_no_texture_no_ambient_light_and_no_bias() -> None:
    bias = dict.fromkeys(("range_offset_m", "ripple_m", "patch_drift_m", "drift_m_per_celsius"), 0.0)
    assert SensorModel() == SensorModel(pulse_ns=0, wall_texture=0, ambient_counts=0, warm_up=None, **bias)


@pytest.mark.parametrize("field", ["range_offset_m", "drift_m_per_celsius"])
def test_an_offset_and_a_drift_have_either_sign(field: str) -> None:
    for value in (-1.0, 1.0):
        assert getattr(SensorModel.model_validate({field: value}), field) == value
    for value in (-1.1, 1.1, float("nan")):
        with pytest.raises(ValidationError, match=field):
            SensorModel.model_validate({field: value})


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"from_celsius": 45.0}, "from_celsius < to_celsius"),
        ({"from_celsius": 50.0}, "from_celsius < to_celsius"),
        ({"from_celsius": -1.0}, "from_celsius"),
        ({"to_celsius": 101.0}, "to_celsius"),
        ({"to_celsius": float("nan")}, "to_celsius"),
        ({"time_constant_s": 0.0}, "time_constant_s"),
        ({"time_constant_s": float("inf")}, "time_constant_s"),
        ({"time_constant_min": 1.0}, "time_constant_min"),
    ],
)
def test_a_warm_up_that_cannot_be_is_told(wrong: dict[str, float], named: str) -> None:
    fields = {"from_celsius": 25.0, "to_celsius": 45.0, "time_constant_s": 600.0}
    with pytest.raises(ValidationError, match=named):
        SensorModel.model_validate({"warm_up": fields | wrong})


@given(st.floats(0, 1e5), st.floats(0, 1e5))
def test_a_device_warms_and_never_beyond_where_its_warm_up_ends(one_s: float, other_s: float) -> None:
    model = SensorModel(warm_up=WarmUp(from_celsius=25, to_celsius=45, time_constant_s=600))
    earlier, later = (model.celsius_at(seconds) for seconds in sorted((one_s, other_s)))
    assert 25 <= earlier <= later <= 45
    # what is still missing shrinks by 1/e in each time constant
    assert 45 - model.celsius_at(one_s + 600) == pytest.approx((45 - model.celsius_at(one_s)) / 2.718281828, abs=1e-6)


def test_without_a_warm_up_the_temperature_is_steady() -> None:
    assert SensorModel().celsius_at(0) == SensorModel().celsius_at(1e6) == STEADY_CELSIUS
