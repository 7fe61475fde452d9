"""The dial: stops by name, and settings that no renderer has."""

from dataclasses import replace

import pytest

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import MAX_BEAMS_PER_CELL, MAX_RELAY_CELLS, STOPS, Accuracy, accuracy_named


def test_a_stop_goes_by_its_name_and_a_setting_is_itself() -> None:
    for name, stop in STOPS.items():
        assert stop.name == name
        assert accuracy_named(name) is stop
    own = Accuracy("own", sub_bins=2)
    assert accuracy_named(own) is own


def test_stops_get_finer_in_order() -> None:
    tolerances = [stop.tolerance for stop in STOPS.values()]
    assert tolerances == sorted(tolerances, reverse=True)
    assert tolerances[-1] == 0
    assert [name for name, stop in STOPS.items() if stop.sub_bins == 0] == ["reference"]


def test_another_name_is_refused_with_those_that_are() -> None:
    with pytest.raises(SceneError, match="no accuracy 'best': choose one of draft, standard, fine, reference"):
        accuracy_named("best")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("relay_columns", 0),
        ("relay_rows", MAX_RELAY_CELLS + 1),
        ("object_stride", 0),
        ("sectors", 0),
        ("beams_per_cell", MAX_BEAMS_PER_CELL + 1),
        ("scatter_error", 0.0),
        ("tolerance", -1e-9),
        ("tolerance", float("nan")),
        ("sub_bins", 3),
        ("sub_bins", 128),
        ("sub_bins", -1),
    ],
)
def test_a_setting_out_of_range_is_refused_by_field_value_and_range(field: str, value: float) -> None:
    with pytest.raises(SceneError, match=rf"^{field} is {value}: it must .*"):
        replace(STOPS["standard"], **{field: value})
