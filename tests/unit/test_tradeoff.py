"""The trade-off of a small scene: every setting once, brute force first, errors that shrink as settings grow."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.evaluate.render_tradeoff import (
    REPEATS,
    Part,
    RenderRow,
    measure_renders,
    pareto_front,
    render_facts,
    render_settings,
)
from nlos_cam.render.accuracy import STOPS
from nlos_cam.render.accuracy_search import Agreement, Work
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
SMALL = {name: replace(stop, relay_columns=12, relay_rows=8) for name, stop in STOPS.items()}
"""The dial on a relay wall that brute force is quick with."""


def _scene() -> Scene:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[4:8, 4:12] = 0.2 + 0.002 * np.arange(8)
    return Scene(RIG, depth)


class CountedSeconds:
    """A stopwatch by which the n-th piece of work takes n seconds."""

    def __init__(self) -> None:
        self.repeats: list[int] = []
        self._seconds: Iterator[int] = count(1)

    def __call__(self, work: Work, repeats: int) -> float:
        work()
        self.repeats.append(repeats)
        return float(next(self._seconds))


@pytest.fixture(scope="module")
def rows() -> list[RenderRow]:
    return list(measure_renders(_scene(), SMALL, CountedSeconds()))


def _of(rows: list[RenderRow], part: Part) -> list[RenderRow]:
    return [row for row in rows if row.part == part]


def test_every_setting_is_measured_once_brute_force_first(rows: list[RenderRow]) -> None:
    planned = render_settings(_scene(), SMALL)
    assert [(row.name, row.part) for row in rows] == [(setting.name, setting.part) for setting in planned]
    assert len({row.name for row in rows}) == len(rows)
    assert [row.name for row in _of(rows, "stop")] == ["reference", "draft", "standard", "fine"]


def test_ingredients_are_the_standard_stop_with_one_thing_changed() -> None:
    standard = SMALL["standard"]
    for setting in render_settings(_scene(), SMALL):
        changed = {name for name in vars(standard) if getattr(setting.accuracy, name) != getattr(standard, name)}
        allowed = {
            "sub_bins": {"sub_bins"},
            "relay grid": {"relay_columns", "relay_rows"},
            "object_stride": {"object_stride"},
            "beams_per_cell": {"beams_per_cell"},
            "effect left out": set[str](),
        }
        assert setting.part == "stop" or changed <= allowed[setting.part]
        assert (setting.effects == "auto") == (setting.part != "effect left out")


def test_on_the_default_dial_the_relay_grid_runs_from_a_quarter_to_twice() -> None:
    names = [s.name for s in render_settings(_scene()) if s.part == "relay grid"]
    assert names == [f"relay grid {grid}" for grid in ("20 x 16", "40 x 32", "80 x 64", "160 x 128")]


def test_each_effect_that_the_scene_calls_for_is_left_out_once(rows: list[RenderRow]) -> None:
    names = {row.name.removeprefix("without ") for row in _of(rows, "effect left out")}
    assert {"direct", "three-bounce", "occluder", "tilt"} <= names
    assert "colour" not in names
    without = next(row for row in rows if row.name == "without tilt")
    kept = next(row for row in rows if row.name == "standard")
    assert without.errors.intensity_error_median > 2 * kept.errors.intensity_error_median
    nothing = next(row for row in rows if row.name == "without three-bounce")
    assert nothing.errors.intensity_error_median == 1
    assert nothing.errors.bin_within_1 == 0


def test_brute_force_is_itself_and_runs_once(rows: list[RenderRow]) -> None:
    assert rows[0].speedup == 1
    assert rows[0].errors.intensity_error_max == 0
    assert rows[0].errors.bin_exact == 1
    watch = CountedSeconds()
    next(measure_renders(_scene(), SMALL, watch))
    assert watch.repeats == [1]


def test_times_and_ratios_are_those_of_the_stopwatch(rows: list[RenderRow]) -> None:
    assert [row.seconds for row in rows] == list(range(1, len(rows) + 1))
    assert all(row.speedup == rows[0].seconds / row.seconds for row in rows)
    watch = CountedSeconds()
    some = measure_renders(_scene(), SMALL, watch)
    next(some), next(some)
    assert watch.repeats == [1, REPEATS]


def test_more_sub_bins_are_nearer(rows: list[RenderRow]) -> None:
    errors = [row.errors.intensity_error_median for row in _of(rows, "sub_bins")]
    assert errors[0] > errors[3] > errors[-1]
    assert errors[-1] < 0.1 * errors[0]


def test_the_same_setting_has_the_same_errors_wherever_it_stands(rows: list[RenderRow]) -> None:
    same = [
        row.errors for row in rows if row.name in {"standard", "sub_bins 8", "object_stride 1", "relay grid 12 x 8"}
    ]
    assert len(same) == 4
    assert len(set(same)) == 1


def test_beams_per_cell_are_held_against_more_of_them(rows: list[RenderRow]) -> None:
    one, two = _of(rows, "beams_per_cell")
    assert one.errors.intensity_error_median > two.errors.intensity_error_median > 0
    assert one.errors.intensity_error_p99 > two.errors.intensity_error_p99


def test_facts_count_what_brute_force_goes_over() -> None:
    size = render_facts(_scene(), SMALL)
    assert size.patches == 32
    assert 3000 < size.beams_on_wall < 5120


@pytest.mark.parametrize("hidden", [None, "empty"])
def test_where_nothing_is_hidden_there_is_nothing_to_trade(hidden: str | None) -> None:
    depth = None if hidden is None else np.full((16, 16), np.nan, np.float32)
    with pytest.raises(SceneError, match="nothing is hidden"):
        render_facts(Scene(RIG, depth), SMALL)


def _row(name: str, seconds: float, error: float, part: Part = "sub_bins") -> RenderRow:
    return RenderRow(name, part, seconds, 1 / seconds, Agreement(0, error, error, 1, 1, 0, 0))


def test_the_front_holds_what_nothing_beats() -> None:
    rows = [
        _row("slow and exact", 9, 0.0, "stop"),
        _row("quick", 1, 0.1),
        _row("beaten", 3, 0.1),
        _row("beaten in both", 4, 0.2),
        _row("middling", 2, 0.05),
        _row("tie in time, worse", 2, 0.06),
        _row("another truth", 0.1, 0.0, "beams_per_cell"),
        _row("map alone", 0.1, 0.0, "effect left out"),
    ]
    assert [row.name for row in pareto_front(rows)] == ["quick", "middling", "slow and exact"]
    assert pareto_front([]) == []
