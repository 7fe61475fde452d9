"""The sensor model: what it refuses, by the name of the field."""

import pytest
from pydantic import ValidationError

from nlos_cam.render.sensor_model import SATURATED, SensorModel

MOST = {
    "pulse_ns": 100.0,
    "ambient_counts": 254.9,
    "range_noise_m": 10.0,
    "range_noise_per_m": 1.0,
    "read_noise_counts": 255.0,
    "shot_noise": 255.0,
    "dead_share": 0.99,
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


def test_unless_asked_there_is_neither_a_pulse_nor_ambient_light() -> None:
    assert SensorModel() == SensorModel(pulse_ns=0, ambient_counts=0)
