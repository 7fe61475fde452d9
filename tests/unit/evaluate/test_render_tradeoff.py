"""Trade-off of the renderer on a small scene: every setting once, and its table and plot."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from depth_maps import depth_map
from nlos_calibration import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.evaluate import (
    RenderRow,
    as_table,
    measure_renders,
    render_document,
    render_facts,
    render_settings,
)
from nlos_cam.evaluate.render_tradeoff import REPEATS, Part, RenderFacts, draw_renders, machine
from nlos_cam.render import STOPS, Agreement, Scene, Work

RIG = load_rig("paper-rig")
SMALL = {name: replace(stop, relay_columns=12, relay_rows=8) for name, stop in STOPS.items()}
"""The stops on a small relay wall."""


def _scene() -> Scene:
    return Scene(RIG, depth_map(16, np.nan, (np.s_[4:8, 4:12], 0.2 + 0.002 * np.arange(8))))


@pytest.fixture(scope="module")
def repeats() -> list[int]:
    """How often each piece of work was to be repeated."""
    return []


@pytest.fixture(scope="module")
def rows(repeats: list[int]) -> list[RenderRow]:
    """Rows by a stopwatch on which the n-th piece of work takes n seconds."""

    def watch(work: Work, times: int) -> float:
        work()
        repeats.append(times)
        return float(len(repeats))

    return list(measure_renders(_scene(), SMALL, watch))


def _of(rows: list[RenderRow], part: Part) -> list[RenderRow]:
    return [row for row in rows if row.part == part]


def test_measure_runs_every_setting_once(rows: list[RenderRow]) -> None:
    planned = render_settings(_scene(), SMALL)

    assert [(row.name, row.part) for row in rows] == [(one.name, one.part) for one in planned]
    assert len({row.name for row in rows}) == len(rows)


def test_measure_runs_brute_force_first(rows: list[RenderRow]) -> None:
    reference = rows[0]

    assert [row.name for row in _of(rows, "stop")] == ["reference", "draft", "standard", "fine"]
    assert reference.speedup == 1
    assert reference.errors.intensity_error_max == 0
    assert reference.errors.bin_exact == 1


def test_measure_takes_times_and_speedups(rows: list[RenderRow]) -> None:
    assert [row.seconds for row in rows] == list(range(1, len(rows) + 1))
    assert all(row.speedup == rows[0].seconds / row.seconds for row in rows)


def test_measure_repeats_all_but_brute_force(rows: list[RenderRow], repeats: list[int]) -> None:
    assert repeats == [1, *[REPEATS] * (len(rows) - 1)]


def test_settings_change_one_field_of_the_standard_stop() -> None:
    standard = vars(SMALL["standard"])
    allowed = {"relay grid": {"relay_columns", "relay_rows"}, "effect left out": set[str]()}

    for setting in render_settings(_scene(), SMALL):
        changed = {name for name in standard if getattr(setting.accuracy, name) != standard[name]}
        assert setting.part == "stop" or changed <= allowed.get(setting.part, {setting.part})
        assert (setting.effects == "auto") == (setting.part != "effect left out")


def test_settings_have_relay_grids_from_coarse_to_fine() -> None:
    names = [one.name for one in render_settings(_scene()) if one.part == "relay grid"]

    grids = ("20 x 16", "40 x 32", "80 x 64", "160 x 128")

    assert names == [f"relay grid {grid}" for grid in grids]


def _errors(rows: list[RenderRow], name: str) -> Agreement:
    return next(row for row in rows if row.name == name).errors


def test_effects_of_the_scene_are_left_out_in_turn(rows: list[RenderRow]) -> None:
    names = {row.name.removeprefix("without ") for row in _of(rows, "effect left out")}

    assert {"direct", "three-bounce", "occluder", "tilt"} <= names
    assert "colour" not in names


def test_error_is_whole_without_three_bounces(rows: list[RenderRow]) -> None:
    nothing = _errors(rows, "without three-bounce")

    assert nothing.intensity_error_median == 1
    assert nothing.bin_within_1 == 0


def test_error_shrinks_with_sub_bins(rows: list[RenderRow]) -> None:
    errors = [row.errors.intensity_error_median for row in _of(rows, "sub_bins")]

    assert errors[0] > errors[3] > errors[-1]
    assert errors[-1] < 0.1 * errors[0]


def test_error_shrinks_with_beams(rows: list[RenderRow]) -> None:
    one, two = (row.errors for row in _of(rows, "beams_per_cell"))

    assert one.intensity_error_median > two.intensity_error_median > 0
    assert one.intensity_error_p99 > two.intensity_error_p99


def test_facts_count_patches_and_beams() -> None:
    size = render_facts(_scene(), SMALL)

    assert size.patches == 32
    assert 3000 < size.beams_on_wall < 5120


@pytest.mark.parametrize("depth_m", [None, np.full((16, 16), np.nan, np.float32)])
def test_facts_of_an_empty_scene_are_refused(depth_m: np.ndarray | None) -> None:
    with pytest.raises(SceneError, match="hidden"):
        render_facts(Scene(RIG, depth_m), SMALL)


def _row(name: str, part: Part, seconds: float, *errors: float) -> RenderRow:
    return RenderRow(name, part, seconds, 20.0 / seconds, Agreement(*errors))


ROWS = [
    _row("reference", "stop", 20.0, 0, 0, 0, 1, 1, 0, 0),
    _row("draft", "stop", 0.005, 0.005, 0.03, 0.05, 0.8, 0.99, 0, 1.4),
    _row("sub_bins 2", "sub_bins", 0.01, 0.001, 0.005, 0.007, 0.9, 1, 0, 0.4),
    _row("sub_bins 1", "sub_bins", 0.01, 0.001, 0.006, 0.007, 0.9, 1, 0, 0.4),
    _row("object_stride 1", "object_stride", 0.02, 0.001, 0.04, 0.05, 0.9, 1, 0, 0.4),
    _row("beams_per_cell 2", "beams_per_cell", 0.001, 0, 0.001, 0.002, 1, 1, 0, 0),
    _row("without tilt", "effect left out", 0.001, 0.2, 0.3, 0.4, 0.1, 0.7, 0, 11),
]
FACTS = RenderFacts(patches=702, beams_on_wall=3776)


@pytest.fixture
def table() -> dict[str, Any]:
    """The table of all rows, as scripts read it."""
    return json.loads(json.dumps(as_table(FACTS, ROWS, len(ROWS)), allow_nan=False))


def test_table_is_json_with_fixed_keys(table: dict[str, Any]) -> None:
    keys = (
        "name seconds speedup intensity_error_median intensity_error_p99 bin_exact bin_within_1"
        " depth_error_mm"
    )

    assert all(set(stop) >= {*keys.split()} for stop in table["stops"])
    assert table["patches"] == 702
    assert table["beams_on_wall"] == 3776
    assert table["reference_seconds"] == 20.0
    assert table["complete"]


def test_table_separates_stops_from_ingredients(table: dict[str, Any]) -> None:
    ingredients = [(row["name"], row["part"]) for row in table["ingredients"]]

    assert [stop["name"] for stop in table["stops"]] == ["reference", "draft"]
    assert ingredients == [(row.name, row.part) for row in ROWS[2:]]


def test_pareto_front_is_undominated_and_of_brute_forces_truth(table: dict[str, Any]) -> None:
    assert table["pareto_front"] == ["draft", "sub_bins 2", "reference"]


DRAFT_LINE = "| draft | 5.0 | 4000 | 0.5 | 3 | 5 | 80.00 | 99.00 | 0.00 | 1.40 |"


@pytest.mark.parametrize("measured", [0, 1, 3, len(ROWS)])
def test_table_holds_what_was_measured(measured: int) -> None:
    table = as_table(FACTS, ROWS[:measured], len(ROWS))

    assert table["complete"] == (measured == len(ROWS))
    assert bool(table["pareto_front"]) == (measured > 0)
    assert len(table["stops"]) + len(table["ingredients"]) == measured


@pytest.mark.parametrize("measured", [1, 3, len(ROWS)])
def test_document_holds_what_was_measured(measured: int) -> None:
    rows = ROWS[:measured]

    text = render_document(as_table(FACTS, rows, len(ROWS)), "cup").as_markdown()

    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}

    assert all(f"| {row.name} |" in text for row in rows)
    assert len(widths) == 1
    assert (DRAFT_LINE in text) == (measured > 1)


@pytest.mark.parametrize("measured", [1, 3, len(ROWS)])
def test_document_says_whether_it_is_complete(measured: int) -> None:
    table = as_table(FACTS, ROWS[:measured], len(ROWS))
    complete = render_document({**table, "complete": True}, "cup").as_markdown()

    text = render_document(table, "cup").as_markdown()

    assert (text == complete) == (measured == len(ROWS))


@pytest.mark.parametrize("measured", [1, 3, len(ROWS)])
def test_plot_is_drawn_of_what_was_measured(tmp_path: Path, measured: int) -> None:
    draw_renders(tmp_path / "plot.png", ROWS[:measured], "a title")

    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_machine_has_a_name() -> None:
    assert machine()
