"""Trade-off of the reconstruction: settings, timing by a given clock, recommendation, table and
plot.
"""

import json
from dataclasses import replace
from itertools import count as ticking
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models import load_record, shipped_folder
from page_reader import read_page

from nlos_cam.dataset import TEST_SEED
from nlos_cam.evaluate import (
    ReconstructRow,
    measure_reconstructions,
    reconstruct_facts,
    reconstruct_settings,
    reconstruct_tradeoff,
)
from nlos_cam.evaluate.metrics import Interval
from nlos_cam.evaluate.reconstruct_tradeoff import (
    BothSets,
    ObjectSet,
    ReconstructBench,
    ReconstructSetting,
    draw_reconstructions,
    losses,
    pareto_front,
    recommended,
    reconstruct_document,
)
from nlos_cam.evaluate.subjects import seeded_objects, untracked
from nlos_cam.objects.depth_map import object_box

RIG = load_rig("paper-rig")
BOX = object_box(RIG)


def row_of(name: str, milliseconds: float, iou: float, frames: int = 1) -> ReconstructRow:
    figures = {
        "silhouette_iou": Interval(iou, iou - 0.1, iou + 0.1),
        "accuracy_mean_abs": Interval(0.9, 0.8, 1.0),
        "accuracy_within_2_percent": Interval(0.7, 0.6, 0.8),
        "foreground_rmse_mm": Interval(20.0, 10.0, 30.0),
    }
    setting = ReconstructSetting(name, "shipped", "a runtime", frames, RIG.name)
    return ReconstructRow(setting, milliseconds, 2 * milliseconds, figures, figures)


ROWS = [
    row_of("exact", 80, 0.8),
    row_of("quick", 20, 0.799),
    row_of("quicker", 10, 0.7),
    row_of("many", 5, 0.802, frames=16),
]


def facts_of(rows: list[ReconstructRow], planned: int) -> dict[str, Any]:
    facts = reconstruct_facts(rows, planned, 54, "a machine")
    return json.loads(json.dumps(facts, allow_nan=False))


def test_recommended_is_the_first_that_is_as_good_as_the_best() -> None:
    assert recommended(ROWS).setting.name == "quick"
    assert recommended(ROWS[:1]).setting.name == "exact"
    assert recommended([]) is None


def test_setting_without_a_value_is_not_recommended() -> None:
    blind = {**ROWS[1].figures, "foreground_rmse_mm": Interval(None, None, None)}

    assert recommended([ROWS[0], replace(ROWS[1], figures=blind)]).setting.name == "exact"


def test_setting_is_recommended_where_none_has_a_depth_error() -> None:
    blind = {**ROWS[0].figures, "foreground_rmse_mm": Interval(None, None, None)}
    rows = [replace(row, figures=blind) for row in ROWS[:2]]

    assert recommended(rows).setting.name == "quick"


def test_losses_are_positive_where_a_row_is_worse() -> None:
    worse = {
        **ROWS[0].figures,
        "silhouette_iou": Interval(0.7, 0, 1),
        "foreground_rmse_mm": Interval(25.0, 0, 50),
    }

    lost = losses(replace(ROWS[0], figures=worse), ROWS[0])

    assert lost["silhouette_iou"] == pytest.approx(0.1)
    assert lost["foreground_rmse_mm"] == pytest.approx(5)
    assert lost["accuracy_mean_abs"] == 0


def test_front_is_undominated_in_time_to_the_picture_and_iou() -> None:
    names = [row.setting.name for row in pareto_front(ROWS)]

    assert names == ["quicker", "quick", "exact", "many"]

    names = [row.setting.name for row in pareto_front([*ROWS, row_of("best", 1, 0.95)])]

    assert names == ["best"]


def test_settings_are_every_network_with_every_number_of_frames() -> None:
    record = SimpleNamespace(rig_name="wall-grid")  # of weights for any rig
    networks: dict[str, Any] = {
        name: SimpleNamespace(runtime="a runtime", record=record) for name in ("small", "large")
    }
    objects = ObjectSet(RIG, np.zeros((0, 64, 64), np.float32), [])
    sets = dict.fromkeys(networks, BothSets(objects, objects))

    asked = reconstruct_settings(ReconstructBench(networks, sets))

    assert {one.rig for one in asked} == {RIG.name}
    assert len({one.name for one in asked}) == len(asked)

    for weights in networks:
        assert [one.frames for one in asked if one.weights == weights] == [1, 4, 16, 64]


def test_time_is_the_median_of_calls_by_the_given_clock() -> None:
    one = ObjectSet.of(seeded_objects(TEST_SEED, 1, BOX), RIG, untracked)
    calls = list[tuple[int, ...]]()
    seconds = ticking(0.0, 0.003)  # each call lasts one tick

    def plate(depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape
        calls.append(depth_m.shape)
        return np.full((1, 64, 64), 0.5, np.float32)

    network = Mock(spec=("record",), side_effect=plate)
    network.record = load_record(shipped_folder())
    bench = ReconstructBench({"mine": network}, {"mine": BothSets(one, one)})
    asked = [ReconstructSetting("plate", "mine", "any", frames, RIG.name) for frames in (1, 2)]

    rows = list(measure_reconstructions(asked, bench, lambda: next(seconds)))

    # a first call, the timed ones, and one on the object of the other set
    assert calls == [(1, 64, 80)] * 2 * (1 + reconstruct_tradeoff.MIN_CALLS + 1)
    assert [row.milliseconds for row in rows] == pytest.approx([3, 3])
    assert 0 < rows[0].figures["silhouette_iou"].value < 1
    assert rows[0].unseen == rows[0].figures
    assert rows[1].wait_ms == pytest.approx(2 * rows[0].wait_ms)


@pytest.mark.parametrize("measured", [len(ROWS), 1, 0])
def test_table_shows_the_measured_rows(measured: int) -> None:
    table = facts_of(ROWS[:measured], len(ROWS))

    assert table["complete"] == (measured == len(ROWS))

    names = [row["name"] for row in table["settings"]]

    assert names == [row.setting.name for row in ROWS[:measured]]

    lost = [row["loses_accuracy"] for row in table["settings"]]

    assert lost == [False, False, True, False][:measured]

    page = read_page(reconstruct_document(table).as_html())

    assert all(name in page.text for name in names)


@pytest.mark.parametrize(("rig", "camera"), [(RIG.name, "sim"), ("wide-rig", "l515")])
def test_command_is_of_a_camera_on_the_measured_rig(rig: str, camera: str) -> None:
    rows = [replace(ROWS[0], setting=replace(ROWS[0].setting, rig=rig))]
    page = read_page(reconstruct_document(facts_of(rows, 1)).as_html())

    assert f"nlos-cam live {camera} --weights" in page.text


def test_command_quotes_the_folder_of_weights() -> None:
    rows = [replace(ROWS[0], setting=replace(ROWS[0].setting, weights="my weights"))]
    page = read_page(reconstruct_document(facts_of(rows, 1)).as_html())

    assert "--weights 'my weights' --average" in page.text


def test_plot_is_a_picture(tmp_path: Path) -> None:
    draw_reconstructions(tmp_path / "plot.png", ROWS)

    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
