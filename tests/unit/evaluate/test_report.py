"""Evaluation folder: JSON whose names scripts depend on, a table of objects, pictures, and the report."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import procedural_images
from nlos_cam.evaluate import report
from nlos_cam.evaluate.metrics import TARGETS
from nlos_cam.evaluate.report import Evaluation, as_figures, as_markdown, format_interval, write_report
from nlos_cam.objects.depth_map import object_box

BOX = object_box(load_rig("paper-rig"))
FACTS = {"what": "Some objects", "weights": "mine", "rig": "paper-rig", "runtime": "none", "input": "raw maps"}
FACTS |= {"training_objects": 99, "notes": ["they are few"]}
FILES = {"report.md", "figures.json", "objects.csv", "sheet.png", "gallery.png", "categories.png", "surface.png"}


def _judgement(count: int = 7, *, guesses: bool = True) -> Evaluation:
    truth = procedural_images(0, count, BOX).astype(np.float32)
    image = (0.95 * np.roll(truth, 2, axis=2)).astype(np.float32)
    others = {"all_background": np.zeros_like(truth), "nearest_neighbour": np.roll(truth, 1, axis=0)}
    categories, names = [f"kind {k % 3}" for k in range(count)], [f"object {k}" for k in range(count)]
    return Evaluation(names, categories, truth, image, others if guesses else {}, BOX, FACTS)


def _figures(judgement: Evaluation) -> dict[str, Any]:
    return json.loads(json.dumps(as_figures(judgement), allow_nan=False))


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "objects.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_figures_have_names_that_scripts_depend_on() -> None:
    figures = _figures(_judgement())
    assert {*TARGETS, "baselines", "per_category", "objects", "bars", *FACTS} < set(figures)
    assert set(figures["per_category"]) == {"kind 0", "kind 1", "kind 2"}
    for table in (figures, *figures["baselines"].values(), *figures["per_category"].values()):
        assert all(set(table[name]) == {"value", "low", "high"} for name in TARGETS)
    assert figures["objects"] == 7
    assert figures["baselines"]["all_background"]["foreground_rmse_mm"]["value"] is None
    assert figures["advantage_over_nearest_neighbour"]["silhouette_iou"]["value"] > 0
    assert sum(zone["share_of_error"] for zone in figures["where_the_error_is"].values()) == pytest.approx(1)


def test_report_of_perfect_reconstruction_meets_every_bar() -> None:
    perfect = replace(_judgement(), image=_judgement().truth)
    figures = _figures(perfect)
    assert all(bar["met"] for bar in figures["bars"].values())
    assert "not met" not in as_markdown(figures)


def test_report_contains_metrics_pictures_and_notes() -> None:
    text = as_markdown(_figures(_judgement()))
    for name in TARGETS:
        assert f"| {name} | " in text
    for name in FILES:
        assert not name.endswith(".png") or f"({name})" in text
    for words in ("not met", "nearest neighbour", "99", "they are few"):
        assert words in text
    assert "nearest" not in as_markdown(_figures(_judgement(guesses=False)))


@pytest.mark.parametrize("count", [1, 7])
def test_folder_is_complete_for_any_number_of_objects(tmp_path: Path, count: int) -> None:
    judgement, out = _judgement(count), tmp_path / "out"
    figures = as_figures(judgement)
    write_report(out, judgement, figures)
    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "figures.json").read_text(encoding="utf-8")) == _figures(judgement)
    assert [row["name"] for row in _rows(out)] == judgement.names
    mean = np.mean([float(row["silhouette_iou"]) for row in _rows(out)])
    assert mean == pytest.approx(figures["silhouette_iou"]["value"], rel=1e-4)


def test_figures_separate_categories_left_out_of_training() -> None:
    whole = _judgement()
    assert as_figures(whole)["shown_and_left_out"] is None
    blind = np.array([kind == "kind 1" for kind in whole.categories])[:, None, None]
    guessed = _figures(replace(whole, image=np.where(blind, 0, whole.image), left_out=["kind 1", "kind 9"]))
    by = guessed["shown_and_left_out"]
    assert by["left out"]["silhouette_iou"]["value"] == 0
    assert by["shown"]["silhouette_iou"]["value"] > guessed["silhouette_iou"]["value"] > 0
    assert len(as_markdown(guessed)) > len(as_markdown({**guessed, "shown_and_left_out": None}))


def test_interrupted_write_leaves_earlier_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (out := tmp_path / "out").mkdir()
    (out / "report.md").write_text("earlier")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(report.pictures, "draw_gallery", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_report(out, _judgement(3), as_figures(_judgement(3)))
    assert {path.name: path.read_text() for path in out.iterdir()} == {"report.md": "earlier"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_object_without_value_has_an_empty_field(tmp_path: Path) -> None:
    whole = _judgement(2, guesses=False)
    blank = replace(whole, image=0 * whole.truth)
    write_report(tmp_path / "out", blank, as_figures(blank))
    assert {row["foreground_rmse_mm"] for row in _rows(tmp_path / "out")} == {""}
    assert format_interval(_figures(blank)["foreground_rmse_mm"]) == "none"
