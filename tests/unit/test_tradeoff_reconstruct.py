"""The trade-off of reconstruction: what is measured, by whose clock, and what is recommended."""

import json
from dataclasses import replace
from itertools import count as ticking
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.build import TEST_SEED
from nlos_cam.evaluate.metrics import Interval
from nlos_cam.evaluate.runtime_tradeoff import (
    LEAST_CALLS,
    Bench,
    Row,
    Setting,
    as_markdown,
    calibration,
    draw,
    facts,
    losses,
    measure,
    pareto_front,
    recommended,
    settings,
)
from nlos_cam.evaluate.subjects import seeded_objects
from nlos_cam.objects.depth_map import object_box

RIG = load_rig("paper-rig")
BOX = object_box(RIG)


def _row(name: str, milliseconds: float, iou: float, frames: int = 1) -> Row:
    figures = {
        "silhouette_iou": Interval(iou, iou - 0.1, iou + 0.1),
        "accuracy_mean_abs": Interval(0.9, 0.8, 1.0),
        "accuracy_within_2_percent": Interval(0.7, 0.6, 0.8),
        "foreground_rmse_mm": Interval(20.0, 10.0, 30.0),
    }
    return Row(Setting(name, "shipped", name, 1, frames), milliseconds, 2 * milliseconds, figures)


ROWS = [_row("exact", 80, 0.8), _row("quick", 20, 0.799), _row("quicker", 10, 0.7), _row("many", 5, 0.9, frames=16)]


def test_the_quickest_that_loses_nothing_is_recommended() -> None:
    assert recommended(ROWS).setting.name == "quick"
    assert recommended(ROWS[:1]).setting.name == "exact"
    assert recommended([]) is None
    blind = replace(ROWS[1], figures={**ROWS[1].figures, "foreground_rmse_mm": Interval(None, None, None)})
    assert recommended([ROWS[0], blind]).setting.name == "exact"


def test_a_loss_is_positive_where_it_is_worse_whichever_way_the_metric_runs() -> None:
    worse = {**ROWS[0].figures, "silhouette_iou": Interval(0.7, 0, 1), "foreground_rmse_mm": Interval(25.0, 0, 50)}
    lost = losses(replace(ROWS[0], figures=worse), ROWS[0])
    assert lost["silhouette_iou"] == pytest.approx(0.1)
    assert lost["foreground_rmse_mm"] == pytest.approx(5)
    assert lost["accuracy_mean_abs"] == 0


def test_nothing_on_the_front_is_both_slower_and_worse() -> None:
    front = [row.setting.name for row in pareto_front(ROWS)]
    assert front == ["quicker", "quick", "exact"]
    assert [row.setting.name for row in pareto_front([*ROWS, _row("best", 1, 0.95)])] == ["best"]


def test_every_weights_meets_every_runtime_and_threads_once() -> None:
    runtimes = ["torch float32, cpu", "torch float32, cuda", "ONNX Runtime float32"]
    asked = settings(["small", "large"], runtimes)
    assert len({(one.weights, one.name) for one in asked}) == len(asked)
    for weights in ("small", "large"):
        mine = [one for one in asked if one.weights == weights]
        assert {one.frames for one in mine} == {1, 4, 16}
        assert {one.runtime for one in mine} == set(runtimes)
        assert {one.threads for one in mine if one.runtime == "torch float32, cpu"} == {1, 2}
    assert asked[0].frames == 1  # what the others are held against


class Plate:
    """A network that answers with a plate, and tells how many threads it had."""

    def __init__(self) -> None:
        self.threads: set[int] = set()
        self.calls = 0

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape == (1, 64, 80)
        self.threads.add(torch.get_num_threads())
        self.calls += 1
        return np.full((1, 64, 64), 0.5, np.float32)


def test_a_setting_is_timed_by_its_median_on_its_threads_which_are_given_back() -> None:
    bench = Bench.of(seeded_objects(TEST_SEED, 1, BOX), RIG, BOX, lambda *_: None)
    plate, seconds = Plate(), ticking(0.0, 0.003)  # each call lasts one tick
    before = torch.get_num_threads()
    asked = [Setting("plate", "mine", "any", 2, 1), Setting("plate", "mine", "any", 1, 2)]
    rows = list(measure(asked, {"mine": {"any": lambda _: plate}}, bench, lambda: next(seconds)))  # type: ignore[dict-item]
    assert torch.get_num_threads() == before
    assert plate.threads == {1, 2}
    assert plate.calls == 2 * (1 + LEAST_CALLS)
    assert [row.milliseconds for row in rows] == pytest.approx([3, 3])
    assert 0 < rows[0].figures["silhouette_iou"].value < 1
    assert rows[1].wait_ms == pytest.approx(2 * rows[0].wait_ms)


def test_ranges_are_learnt_from_training_objects_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    from nlos_cam.dataset import build
    from nlos_cam.evaluate import runtime_tradeoff

    asked: list[tuple[int, int]] = []

    def kept(first_seed: int, count: int, box: Any) -> Any:
        asked.append((first_seed, count))
        return seeded_objects(first_seed, 2, box)

    monkeypatch.setattr(runtime_tradeoff, "seeded_objects", kept)
    shapes = [(depth.shape, intensity.shape) for depth, intensity in calibration(RIG, BOX)]
    assert shapes == [((1, 64, 80), (1, 64, 80))] * 2
    first_seed, count = asked[0]
    assert build.TRAINING_SEED <= first_seed < first_seed + count < build.HELD_OUT_SEED


@pytest.mark.parametrize("measured", [len(ROWS), 1])
def test_table_and_plot_hold_what_was_measured(tmp_path: Path, measured: int) -> None:
    table = json.loads(json.dumps(facts(ROWS[:measured], len(ROWS), 54, "a machine"), allow_nan=False))
    assert table["complete"] == (measured == len(ROWS))
    assert [row["name"] for row in table["settings"]] == [row.setting.name for row in ROWS[:measured]]
    assert [row["loses_accuracy"] for row in table["settings"]] == [False, False, True, False][:measured]
    text = as_markdown(table)
    assert ("Interrupted" in text) == (measured < len(ROWS))
    assert f"Recommended: {'quick' if measured > 1 else 'exact'} " in text
    draw(tmp_path / "plot.png", ROWS[:measured])
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_of_several_weights_it_is_told_whose_setting_is_recommended() -> None:
    small, large = (
        [replace(row, setting=replace(row.setting, weights=name)) for row in ROWS] for name in ("small", "large")
    )
    table = facts([*large, *small], 8, 54, "a machine")
    assert table["recommended"] == {"name": "quick", "weights": "large"}
    assert {"name": "quicker", "weights": "large"} in table["pareto_front"]
    assert "Recommended: large: quick " in as_markdown(table)


def test_nothing_measured_is_told_as_such() -> None:
    table = facts([], 4, 54, "a machine")
    assert (table["recommended"], table["settings"], table["complete"]) == (None, [], False)
    assert "Nothing was measured" in as_markdown(table)
