"""Tables and plot of a trade-off: all that was measured is in them, whole or cut short."""

import json
from pathlib import Path

import pytest

from nlos_cam.evaluate.render_tradeoff import RenderFacts, RenderRow, as_table, draw_renders, machine, render_markdown
from nlos_cam.render.accuracy_search import Agreement

KEYS = [
    "name",
    "seconds",
    "speedup",
    "intensity_error_median",
    "intensity_error_p99",
    "bin_exact",
    "bin_within_1",
    "depth_error_mm",
]
ROWS = [
    RenderRow("reference", "stop", 20.0, 1.0, Agreement(0, 0, 0, 1, 1, 0, 0)),
    RenderRow("draft", "stop", 0.005, 4000.0, Agreement(0.005, 0.03, 0.05, 0.8, 0.99, 0, 1.4)),
    RenderRow("sub_bins 2", "sub_bins", 0.01, 2000.0, Agreement(0.001, 0.005, 0.007, 0.9, 1, 0, 0.4)),
    RenderRow("beams_per_cell 2", "beams_per_cell", 0.1, 200.0, Agreement(0, 0.001, 0.002, 1, 1, 0, 0)),
    RenderRow("without tilt", "effect left out", 0.02, 1000.0, Agreement(0.2, 0.3, 0.4, 0.1, 0.7, 0, 11)),
]
FACTS = RenderFacts(patches=702, beams_on_wall=3776)


def test_the_table_is_json_with_the_names_that_scripts_depend_on() -> None:
    table = json.loads(json.dumps(as_table(FACTS, ROWS, len(ROWS)), allow_nan=False))
    assert [stop["name"] for stop in table["stops"]] == ["reference", "draft"]
    assert all(set(KEYS) <= set(stop) for stop in table["stops"])
    assert [(row["name"], row["part"]) for row in table["ingredients"]] == [(row.name, row.part) for row in ROWS[2:]]
    assert (table["patches"], table["beams_on_wall"], table["reference_seconds"]) == (702, 3776, 20.0)
    assert table["complete"]
    assert table["pareto_front"] == ["draft", "sub_bins 2", "reference"]


@pytest.mark.parametrize("measured", [0, 1, 3])
def test_a_run_cut_short_says_so(measured: int) -> None:
    table = as_table(FACTS, ROWS[:measured], len(ROWS))
    assert not table["complete"]
    assert len(table["stops"]) + len(table["ingredients"]) == measured
    if measured:
        assert "Interrupted" in render_markdown(table)


def test_every_row_is_a_line_for_people() -> None:
    text = render_markdown(as_table(FACTS, ROWS, len(ROWS)))
    assert all(f"| {row.name} |" in text for row in ROWS)
    assert "| draft | 0.0050 | 4000 | 0.5 % | 3 % | 5 % | 80.00 % | 99.00 % | 0 mm | 1.4 mm |" in text
    assert "Interrupted" not in text
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert len(widths) == 1


def test_the_machine_is_told_in_words() -> None:
    assert "threads" in machine()
    assert "Python 3." in machine()


@pytest.mark.parametrize("rows", [ROWS, ROWS[:1]])
def test_the_plot_is_drawn_whatever_was_measured(tmp_path: Path, rows: list[RenderRow]) -> None:
    draw_renders(tmp_path / "plot.png", rows, "a title")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
