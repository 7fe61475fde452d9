"""A judgement's folder: JSON that scripts depend on, a table of objects, pictures, and a report that tells it all."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.build import procedural_images
from nlos_cam.evaluate import report
from nlos_cam.evaluate.metrics import BARS
from nlos_cam.evaluate.report import Judgement, as_figures, as_markdown, in_words, write
from nlos_cam.objects.depth_map import object_box

BOX = object_box(load_rig("paper-rig"))
FACTS = {
    "what": "Some objects",
    "weights": "mine",
    "rig": "paper-rig",
    "runtime": "none",
    "input": "raw maps",
    "training_objects": 99,
    "notes": ["they are few"],
}
FILES = {"report.md", "figures.json", "objects.csv", "sheet.png", "gallery.png", "categories.png", "surface.png"}


def _judgement(count: int = 7, *, perfect: bool = False, guesses: bool = True) -> Judgement:
    truth = procedural_images(0, count, BOX).astype(np.float32)
    image = truth if perfect else (0.95 * np.roll(truth, 2, axis=2)).astype(np.float32)
    others = {"all_background": np.zeros_like(truth), "nearest_neighbour": np.roll(truth, 1, axis=0)}
    categories = [f"kind {k % 3}" for k in range(count)]
    names = [f"object {k}" for k in range(count)]
    return Judgement(names, categories, truth, image, others if guesses else {}, BOX, FACTS)


def _strict(figures: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(figures, allow_nan=False))


def test_figures_have_the_names_that_scripts_depend_on() -> None:
    figures = _strict(as_figures(_judgement()))
    assert {*BARS, "baselines", "per_category", "objects", "bars", *FACTS} < set(figures)
    assert set(figures["per_category"]) == {"kind 0", "kind 1", "kind 2"}
    tables = figures, *figures["baselines"].values(), *figures["per_category"].values()
    for table in tables:
        for name in BARS:
            assert set(table[name]) == {"value", "low", "high"}
    assert figures["objects"] == 7
    assert figures["baselines"]["all_background"]["foreground_rmse_mm"]["value"] is None
    assert figures["advantage_over_nearest_neighbour"]["silhouette_iou"]["value"] > 0
    assert sum(zone["share_of_error"] for zone in figures["where_the_error_is"].values()) == pytest.approx(1)


def test_a_perfect_reconstruction_meets_every_bar_and_has_no_error_to_place() -> None:
    figures = _strict(as_figures(_judgement(perfect=True)))
    assert all(bar["met"] for bar in figures["bars"].values())
    assert figures["silhouette_iou"] == {"value": 1, "low": 1, "high": 1}
    text = as_markdown(figures)
    assert "not met" not in text
    assert "There is no error." in text


def test_the_report_tells_every_metric_and_what_is_not_reached() -> None:
    text = as_markdown(_strict(as_figures(_judgement())))
    for name in BARS:
        assert f"| {name} | " in text
    assert "not met" in text
    assert "nearest neighbour" in text
    for picture in (name for name in FILES if name.endswith(".png")):
        assert f"({picture})" in text
    assert "of 99 training objects" in text
    assert "**Note**: they are few." in text
    assert "nearest" not in as_markdown(_strict(as_figures(_judgement(guesses=False))))


@pytest.mark.parametrize("count", [1, 7])
def test_the_folder_is_whole_for_any_number_of_objects(tmp_path: Path, count: int) -> None:
    judgement = _judgement(count)
    figures = as_figures(judgement)
    write(tmp_path / "out", judgement, figures)
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    assert json.loads((tmp_path / "out" / "figures.json").read_text(encoding="utf-8")) == _strict(figures)
    with (tmp_path / "out" / "objects.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == judgement.names
    mean = np.mean([float(row["silhouette_iou"]) for row in rows])
    assert mean == pytest.approx(figures["silhouette_iou"]["value"], rel=1e-4)


def test_kinds_that_training_left_out_are_told_apart() -> None:
    whole = _judgement()
    assert as_figures(whole)["shown_and_left_out"] is None
    assert "was not" not in as_markdown(_strict(as_figures(whole)))
    blind = np.array([kind == "kind 1" for kind in whole.categories])[:, None, None]
    guessed = replace(whole, image=np.where(blind, 0, whole.image), left_out=["kind 1", "kind 9"])
    figures = _strict(as_figures(guessed))
    by = figures["shown_and_left_out"]
    assert by["left out"]["silhouette_iou"]["value"] == 0
    assert by["shown"]["silhouette_iou"]["value"] > figures["silhouette_iou"]["value"] > 0
    assert "was not: " in as_markdown(figures)


def test_what_ends_the_writing_leaves_the_earlier_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judgement = _judgement(2)
    write(tmp_path / "out", judgement, as_figures(judgement))
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(report.pictures, "draw_gallery", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", judgement, as_figures(_judgement(3)))
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_object_without_a_value_has_an_empty_field_and_is_no_zero(tmp_path: Path) -> None:
    whole = _judgement(2)
    blank = Judgement(whole.names, whole.categories, whole.truth, 0 * whole.truth, {}, BOX, FACTS)
    write(tmp_path / "out", blank, as_figures(blank))
    with (tmp_path / "out" / "objects.csv").open(encoding="utf-8", newline="") as file:
        assert {row["foreground_rmse_mm"] for row in csv.DictReader(file)} == {""}
    assert in_words(_strict(as_figures(blank))["foreground_rmse_mm"]) == "none"
