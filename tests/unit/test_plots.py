from dataclasses import replace
from typing import Any

import pytest
import rerun as rr
from made_up_moments import full_moment, moment

from nlos_cam.view.drawing import Plots


class Log:
    """Notes what is logged."""

    def __init__(self) -> None:
        self.styles: dict[str, list[str]] = {}
        self.values: dict[str, list[list[float]]] = {}

    def __call__(self, path: str, thing: Any, *, static: bool = False) -> None:
        if isinstance(thing, rr.SeriesLines):
            assert static
            self.styles[path] = thing.names.as_arrow_array().to_pylist()
        else:
            self.values.setdefault(path, []).append(thing.scalars.as_arrow_array().to_pylist())


def test_each_stage_that_is_work_is_a_line_of_its_own_in_milliseconds() -> None:
    log, first = Log(), full_moment(0)
    Plots(log, first).draw(first)
    assert log.styles["latency"] == ["total, ms", "maps, ms", "bench, ms", "network, ms"]
    assert log.values["latency"] == [pytest.approx([20.0, 2.0, 0.1, 9.0])]


def test_there_are_as_many_figures_as_names_whatever_a_later_moment_has() -> None:
    log, first = Log(), full_moment(0)
    plots = Plots(log, first)
    for each in (first, moment(1), full_moment(2), replace(full_moment(3), celsius={"other": 1.0})):
        plots.draw(each)
    for path, values in log.values.items():
        assert {len(figures) for figures in values} == {len(log.styles[path])}, path


def test_temperatures_are_named_when_they_first_come() -> None:
    log, first = Log(), moment(0)
    plots = Plots(log, first)
    plots.draw(first)
    assert "temperature" not in log.styles
    plots.draw(full_moment(1))
    assert log.styles["temperature"] == ["ldd temperature", "mc temperature"]


def test_drops_are_drawn_of_each_moment_and_a_check_once() -> None:
    log = Log()
    plots = Plots(log, full_moment(28))
    for number in range(28, 62):
        plots.draw(full_moment(number))
    assert [value for (value,) in log.values["drops"]] == [number // 50 for number in range(28, 62)]
    assert len(log.values["physics/score"]) == 3
