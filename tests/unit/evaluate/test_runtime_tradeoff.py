"""Runtime trade-off of the reconstruction: settings, timing by a given clock, recommendation, table
and plot.
"""

import json
from dataclasses import replace
from itertools import count as ticking
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from nlos_calibration.rig import load_rig
from page_reader import read_page

from nlos_cam.dataset import HELD_OUT_SEED, TEST_SEED, TRAINING_SEED
from nlos_cam.evaluate import (
    RuntimeRow,
    measure_runtimes,
    runtime_facts,
    runtime_settings,
    runtime_tradeoff,
    runtimes,
)
from nlos_cam.evaluate.metrics import Interval
from nlos_cam.evaluate.runtime_tradeoff import (
    RuntimeBench,
    RuntimeSetting,
    pareto_front,
    recommended,
    runtime_document,
)
from nlos_cam.evaluate.subjects import seeded_objects
from nlos_cam.objects.depth_map import object_box

RIG = load_rig("paper-rig")
BOX = object_box(RIG)


def _row(name: str, milliseconds: float, iou: float, frames: int = 1) -> RuntimeRow:
    figures = {
        "silhouette_iou": Interval(iou, iou - 0.1, iou + 0.1),
        "accuracy_mean_abs": Interval(0.9, 0.8, 1.0),
    }
    figures |= {
        "accuracy_within_2_percent": Interval(0.7, 0.6, 0.8),
        "foreground_rmse_mm": Interval(20.0, 10.0, 30.0),
    }
    return RuntimeRow(
        RuntimeSetting(name, "shipped", name, 1, frames), milliseconds, 2 * milliseconds, figures
    )


ROWS = [
    _row("exact", 80, 0.8),
    _row("quick", 20, 0.799),
    _row("quicker", 10, 0.7),
    _row("many", 5, 0.9, frames=16),
]


def _facts(rows: list[RuntimeRow], planned: int) -> dict[str, Any]:
    return json.loads(json.dumps(runtime_facts(rows, planned, 54, "a machine"), allow_nan=False))


def test_recommended_is_fastest_without_loss_in_any_metric_and_pareto_front_is_undominated() -> (
    None
):
    blind = replace(
        ROWS[1], figures={**ROWS[1].figures, "foreground_rmse_mm": Interval(None, None, None)}
    )
    for rows, name in ((ROWS, "quick"), (ROWS[:1], "exact"), ([ROWS[0], blind], "exact")):
        assert recommended(rows).setting.name == name
    assert recommended([]) is None
    worse = {
        **ROWS[0].figures,
        "silhouette_iou": Interval(0.7, 0, 1),
        "foreground_rmse_mm": Interval(25.0, 0, 50),
    }
    lost = runtime_tradeoff.losses(replace(ROWS[0], figures=worse), ROWS[0])
    assert lost["silhouette_iou"] == pytest.approx(0.1)
    assert lost["foreground_rmse_mm"] == pytest.approx(5)
    assert lost["accuracy_mean_abs"] == 0
    assert [row.setting.name for row in pareto_front(ROWS)] == ["quicker", "quick", "exact"]
    assert [row.setting.name for row in pareto_front([*ROWS, _row("best", 1, 0.95)])] == ["best"]
    table = _facts(
        [
            replace(row, setting=replace(row.setting, weights=of))
            for of in ("large", "small")
            for row in ROWS
        ],
        8,
    )
    assert table["recommended"] == {"name": "quick", "weights": "large"}
    assert {"name": "quicker", "weights": "large"} in table["pareto_front"]
    assert "large: quick" in runtime_document(table).as_markdown()


def test_settings_combine_weights_runtimes_and_threads_once() -> None:
    names = ["torch float32, cpu", "torch float32, cuda", "ONNX Runtime float32"]
    asked = runtime_settings(["small", "large"], names)
    assert len({(one.weights, one.name) for one in asked}) == len(asked)
    for weights in ("small", "large"):
        mine = [one for one in asked if one.weights == weights]
        assert {one.frames for one in mine} == {1, 4, 16}
        assert {one.runtime for one in mine} == set(names)
        assert {one.threads for one in mine if one.runtime == "torch float32, cpu"} == {1, 2}
    assert asked[0].frames == 1  # the baseline of the others


@pytest.mark.slow
def test_mirrored_runtime_answers_mirrored_maps_with_the_mirrored_image(tmp_path: Path) -> None:
    """Of the paper's pipeline; a direct network does so by itself, and has no such runtime."""
    assert not [name for name in runtimes(None, RIG, BOX, tmp_path) if "mirrored" in name]
    network = runtimes(Path("paper"), RIG, BOX, tmp_path)["ONNX Runtime float32, mirrored"](1)
    generator = np.random.default_rng(0)
    depth_m, intensity = (
        generator.uniform(0.3, 0.5, (1, 64, 80)).astype(np.float32) for _ in range(2)
    )
    image = network(depth_m, intensity)
    np.testing.assert_allclose(
        network(depth_m[:, ::-1], intensity[:, ::-1]), image[:, ::-1], atol=1e-6
    )
    assert image.any()


def test_measure_takes_median_and_restores_threads() -> None:
    bench = RuntimeBench.of(seeded_objects(TEST_SEED, 1, BOX), RIG, BOX, lambda *_: None)
    before = torch.get_num_threads()
    threads = list[int]()
    seconds = ticking(0.0, 0.003)  # each call lasts one tick

    def plate(depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape == (1, 64, 80)
        threads.append(torch.get_num_threads())
        return np.full((1, 64, 64), 0.5, np.float32)

    asked = [
        RuntimeSetting("plate", "mine", "any", 2, 1),
        RuntimeSetting("plate", "mine", "any", 1, 2),
    ]
    rows = list(
        measure_runtimes(asked, {"mine": {"any": lambda _: plate}}, bench, lambda: next(seconds))
    )  # type: ignore[dict-item]
    assert torch.get_num_threads() == before
    assert [threads.count(count) for count in (1, 2)] == [1 + runtime_tradeoff.MIN_CALLS] * 2
    assert [row.milliseconds for row in rows] == pytest.approx([3, 3])
    assert 0 < rows[0].figures["silhouette_iou"].value < 1
    assert rows[1].wait_ms == pytest.approx(2 * rows[0].wait_ms)


def test_calibration_uses_training_objects_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Mock(side_effect=lambda first_seed, _, box: seeded_objects(first_seed, 2, box))
    monkeypatch.setattr(runtime_tradeoff.subjects, "seeded_objects", asked)
    shapes = [
        (depth.shape, intensity.shape)
        for depth, intensity in runtime_tradeoff.calibration(RIG, BOX)
    ]
    assert shapes == [((1, 64, 80), (1, 64, 80))] * 2
    first_seed, count, _ = asked.call_args.args
    assert TRAINING_SEED <= first_seed < first_seed + count < HELD_OUT_SEED


@pytest.mark.parametrize("measured", [len(ROWS), 1, 0])
def test_table_and_plot_show_measured_rows(tmp_path: Path, measured: int) -> None:
    table = _facts(ROWS[:measured], len(ROWS))
    assert table["complete"] == (measured == len(ROWS))
    assert [row["name"] for row in table["settings"]] == [
        row.setting.name for row in ROWS[:measured]
    ]
    assert [row["loses_accuracy"] for row in table["settings"]] == [False, False, True, False][
        :measured
    ]
    page = read_page(runtime_document(table).as_html())
    assert all(row["name"] in page.text for row in table["settings"])
    if measured:
        assert table["recommended"]["name"] == ("quick" if measured > 1 else "exact")
        runtime_tradeoff.draw_runtimes(tmp_path / "plot.png", ROWS[:measured])
        assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    else:
        assert table["recommended"] is None
