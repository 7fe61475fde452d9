"""Trade-off of the renderer on a small scene: every setting once, and its table and plot."""

import json
from dataclasses import replace
from pathlib import Path

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


def test_measure_runs_every_setting_once_and_brute_force_first(
    rows: list[RenderRow], repeats: list[int]
) -> None:
    planned = render_settings(_scene(), SMALL)
    assert [(row.name, row.part) for row in rows] == [
        (setting.name, setting.part) for setting in planned
    ]
    assert len({row.name for row in rows}) == len(rows)
    assert [row.name for row in _of(rows, "stop")] == ["reference", "draft", "standard", "fine"]
    assert (rows[0].speedup, rows[0].errors.intensity_error_max, rows[0].errors.bin_exact) == (
        1,
        0,
        1,
    )
    assert [row.seconds for row in rows] == list(range(1, len(rows) + 1))
    assert all(row.speedup == rows[0].seconds / row.seconds for row in rows)
    assert repeats == [1, *[REPEATS] * (len(rows) - 1)]


def test_settings_change_one_field_of_the_standard_stop() -> None:
    standard = SMALL["standard"]
    for setting in render_settings(_scene(), SMALL):
        changed = {
            name
            for name in vars(standard)
            if getattr(setting.accuracy, name) != getattr(standard, name)
        }
        allowed = {"relay grid": {"relay_columns", "relay_rows"}, "effect left out": set[str]()}
        assert setting.part == "stop" or changed <= allowed.get(setting.part, {setting.part})
        assert (setting.effects == "auto") == (setting.part != "effect left out")
    names = [s.name for s in render_settings(_scene()) if s.part == "relay grid"]
    assert names == [
        f"relay grid {grid}" for grid in ("20 x 16", "40 x 32", "80 x 64", "160 x 128")
    ]


def test_error_grows_without_an_effect_of_the_scene_and_shrinks_with_sub_bins_and_beams(
    rows: list[RenderRow],
) -> None:
    names = {row.name.removeprefix("without ") for row in _of(rows, "effect left out")}
    assert {"direct", "three-bounce", "occluder", "tilt"} <= names
    assert "colour" not in names
    without = next(row for row in rows if row.name == "without tilt")
    kept = next(row for row in rows if row.name == "standard")
    assert without.errors.intensity_error_median > 2 * kept.errors.intensity_error_median
    nothing = next(row for row in rows if row.name == "without three-bounce")
    assert nothing.errors.intensity_error_median == 1
    assert nothing.errors.bin_within_1 == 0
    errors = [row.errors.intensity_error_median for row in _of(rows, "sub_bins")]
    assert errors[0] > errors[3] > errors[-1]
    assert errors[-1] < 0.1 * errors[0]
    one, two = _of(rows, "beams_per_cell")
    assert one.errors.intensity_error_median > two.errors.intensity_error_median > 0
    assert one.errors.intensity_error_p99 > two.errors.intensity_error_p99


def test_facts_count_patches_and_beams_and_refuse_an_empty_scene() -> None:
    size = render_facts(_scene(), SMALL)
    assert size.patches == 32
    assert 3000 < size.beams_on_wall < 5120
    for depth in (None, np.full((16, 16), np.nan, np.float32)):
        with pytest.raises(SceneError, match="hidden"):
            render_facts(Scene(RIG, depth), SMALL)


ROWS = [
    RenderRow("reference", "stop", 20.0, 1.0, Agreement(0, 0, 0, 1, 1, 0, 0)),
    RenderRow("draft", "stop", 0.005, 4000.0, Agreement(0.005, 0.03, 0.05, 0.8, 0.99, 0, 1.4)),
    RenderRow(
        "sub_bins 2", "sub_bins", 0.01, 2000.0, Agreement(0.001, 0.005, 0.007, 0.9, 1, 0, 0.4)
    ),
    RenderRow(
        "sub_bins 1", "sub_bins", 0.01, 2000.0, Agreement(0.001, 0.006, 0.007, 0.9, 1, 0, 0.4)
    ),
    RenderRow(
        "object_stride 1",
        "object_stride",
        0.02,
        1000.0,
        Agreement(0.001, 0.04, 0.05, 0.9, 1, 0, 0.4),
    ),
    RenderRow(
        "beams_per_cell 2", "beams_per_cell", 0.001, 20000.0, Agreement(0, 0.001, 0.002, 1, 1, 0, 0)
    ),
    RenderRow(
        "without tilt", "effect left out", 0.001, 20000.0, Agreement(0.2, 0.3, 0.4, 0.1, 0.7, 0, 11)
    ),
]
FACTS = RenderFacts(patches=702, beams_on_wall=3776)


def test_table_is_json_with_fixed_keys() -> None:
    table = json.loads(json.dumps(as_table(FACTS, ROWS, len(ROWS)), allow_nan=False))
    assert [stop["name"] for stop in table["stops"]] == ["reference", "draft"]
    keys = (
        "name seconds speedup intensity_error_median intensity_error_p99 bin_exact bin_within_1"
        " depth_error_mm"
    )
    assert all(set(stop) >= {*keys.split()} for stop in table["stops"])
    assert [(row["name"], row["part"]) for row in table["ingredients"]] == [
        (row.name, row.part) for row in ROWS[2:]
    ]
    assert (table["patches"], table["beams_on_wall"], table["reference_seconds"]) == (
        702,
        3776,
        20.0,
    )
    assert table["complete"]
    assert table["pareto_front"] == [
        "draft",
        "sub_bins 2",
        "reference",
    ]  # undominated, of brute force's truth


@pytest.mark.parametrize("measured", [0, 1, 3, len(ROWS)])
def test_table_markdown_and_plot_hold_what_was_measured(tmp_path: Path, measured: int) -> None:
    rows = ROWS[:measured]
    table = as_table(FACTS, rows, len(ROWS))
    assert (table["complete"], bool(table["pareto_front"])) == (rows == ROWS, bool(rows))
    assert len(table["stops"]) + len(table["ingredients"]) == measured
    if rows:
        text = render_document(table, "cup").as_markdown()
        assert (text == render_document({**table, "complete": True}, "cup").as_markdown()) == (
            rows == ROWS
        )
        assert all(f"| {row.name} |" in text for row in rows)
        assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1
        assert (
            measured < 2
            or "| draft | 5.0 | 4000 | 0.5 | 3 | 5 | 80.00 | 99.00 | 0.00 | 1.40 |" in text
        )
        draw_renders(tmp_path / "plot.png", rows, "a title")
        assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    assert machine()
