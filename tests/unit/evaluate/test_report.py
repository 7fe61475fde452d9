"""Evaluation folder: JSON whose names scripts depend on, a table of objects, pictures, and the
report.
"""

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import CheckpointRecord
from page_reader import read_page

from nlos_cam.dataset import procedural_images
from nlos_cam.evaluate import LABELS, report, subjects
from nlos_cam.evaluate.metrics import TARGETS, Interval, Predictions
from nlos_cam.evaluate.report import (
    Evaluation,
    Unseen,
    as_figures,
    document,
    format_interval,
    write_report,
)
from nlos_cam.objects import object_box, object_depth
from nlos_cam.render import SensorModel
from nlos_cam.report import figure_of, png

BOX = object_box(load_rig("paper-rig"))
FACTS = {
    "what": "Some objects",
    "weights": "mine",
    "rig": "paper-rig",
    "runtime": "none",
    "input": "raw maps",
}
FACTS |= {"training_objects": 99, "notes": ["they are few"]}
PICTURES = {"sheet.png", "gallery.png", "categories.png", "surface.png"}
FILES = {"report.html", "report.md", "figures.json", "objects.csv", *PICTURES}


@cache
def _judgement(count: int = 7, *, guesses: bool = True) -> Evaluation:
    truth = procedural_images(0, count, BOX).astype(np.float32)
    image = (0.95 * np.roll(truth, 2, axis=2)).astype(np.float32)
    others = {
        "all_background": np.zeros_like(truth),
        "nearest_neighbour": np.roll(truth, 1, axis=0),
    }
    categories = [f"kind {k % 3}" for k in range(count)]
    names = [f"object {k}" for k in range(count)]
    return Evaluation(names, categories, truth, image, others if guesses else {}, BOX, FACTS)


def _figures(judgement: Evaluation) -> dict[str, Any]:
    return json.loads(json.dumps(as_figures(judgement), allow_nan=False))


@cache
def _usual(*, guesses: bool = True) -> dict[str, Any]:
    return _figures(_judgement(guesses=guesses))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the pictures of a report."""
    folder = tmp_path_factory.mktemp("drawn")
    for name in PICTURES:
        (folder / name).write_bytes(png(figure_of(1.0, 1.0)))
    return folder


@pytest.fixture
def undrawn(drawn: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of one inch, for tests of the text beside them."""
    small = (drawn / "sheet.png").read_bytes()
    for name in ("sheet", "gallery", "categories", "against_surface"):
        monkeypatch.setattr(
            report.pictures, f"draw_{name}", lambda path, *_: path.write_bytes(small)
        )


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "objects.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_weights_are_measured_at_the_gain_of_their_training() -> None:
    rig = load_rig("paper-rig")
    own = CheckpointRecord(rig_name=rig.name, rig_checksum=rig.checksum, bare_wall_counts=120.0)
    moved = rig.model_copy(update={"lidar": rig.lidar.model_copy(update={"distance_m": 0.205})})

    assert subjects.sensor_of(own, rig).bare_wall_counts == 120.0
    assert subjects.sensor_of(own, moved) == SensorModel()  # alignment takes the gain out
    assert (
        subjects.sensor_of(own.model_copy(update={"bare_wall_counts": None}), rig) == SensorModel()
    )


def test_figures_have_names_that_scripts_depend_on() -> None:
    figures = _usual()

    assert {*TARGETS, "baselines", "per_category", "objects", "bars", *FACTS} < set(figures)
    assert set(figures["per_category"]) == {"kind 0", "kind 1", "kind 2"}

    for table in (figures, *figures["baselines"].values(), *figures["per_category"].values()):
        assert all(set(table[name]) == {"value", "low", "high"} for name in TARGETS)


def test_figures_count_objects_and_compare_with_baselines() -> None:
    figures = _usual()

    assert figures["objects"] == 7
    assert figures["baselines"]["all_background"]["foreground_rmse_mm"]["value"] is None
    assert figures["advantage_over_nearest_neighbour"]["silhouette_iou"]["value"] > 0


def test_frames_of_one_object_make_no_interval_narrower() -> None:
    one = _judgement()
    several = replace(
        one,
        names=[name for name in one.names for _ in range(4)],
        categories=[kind for kind in one.categories for _ in range(4)],
        truth=np.repeat(one.truth, 4, axis=0),
        image=np.repeat(one.image, 4, axis=0),
        guesses={name: np.repeat(guess, 4, axis=0) for name, guess in one.guesses.items()},
    )
    found = _figures(several)

    assert (found["objects"], found["frames"]) == (7, 28)
    for name in (*TARGETS, "advantage_over_nearest_neighbour", "per_category", "rank_correlation"):
        assert found[name] == _usual()[name]


def test_figures_share_the_error_between_zones() -> None:
    zones = _usual()["where_the_error_is"].values()

    assert sum(zone["share_of_error"] for zone in zones) == pytest.approx(1)


@pytest.mark.parametrize("name", ["quality", "shown_and_left_out", "unseen", "recognised"])
def test_figures_of_what_was_not_measured_are_none(name: str) -> None:
    assert _usual()[name] is None


@pytest.fixture
def with_quality() -> Evaluation:
    """An evaluation with predicted quality, of a cup, generic shapes and kinds never seen."""
    made = _judgement()
    iou = made.ours["silhouette_iou"]
    predicted = Predictions(iou - 0.1, iou, iou + 0.1, iou, iou > np.median(iou))
    unseen = Unseen(made.names, made.truth, made.image, predicted)
    categories = ["cup", *made.categories[1:]]
    return replace(made, categories=categories, predicted=predicted, unseen=unseen)


def _written(folder: Path, evaluation: Evaluation) -> str:
    """Write a report into the folder; return its text."""
    write_report(folder, evaluation, _figures(evaluation))
    return (folder / "report.md").read_text(encoding="utf-8")


def test_predicted_quality_has_figures_by_set(with_quality: Evaluation) -> None:
    quality = _figures(with_quality)["quality"]

    assert set(quality) == {"objects", "the 18 kinds", "generic shapes", "kinds never seen"}
    assert quality["objects"]["correlation"] == pytest.approx(1)


@pytest.mark.usefixtures("undrawn")
def test_predicted_quality_is_reported_by_share_with_a_picture(
    tmp_path: Path, with_quality: Evaluation
) -> None:
    text = _written(tmp_path / "out", with_quality)

    assert "(quality.png)" in text
    assert "shown in green" in text


def test_report_has_its_pictures(drawn: Path) -> None:
    made = document(_usual(), drawn)
    text = made.as_markdown()

    assert len(read_page(made.as_html()).pictures) == 4
    assert all(f"({name})" in text for name in PICTURES)


@pytest.mark.parametrize(
    "words",
    [
        *LABELS.values(),
        "0 of 4 targets met",
        "nearest neighbour",
        "99",
        "they are few",
        "nlos-cam live",
    ],
)
def test_report_contains_metrics_and_notes(drawn: Path, words: str) -> None:
    made = document(_usual(), drawn)

    assert words in read_page(made.as_html()).text
    assert words in made.as_markdown()


def test_report_without_baselines_names_none(drawn: Path) -> None:
    assert "nearest" not in document(_usual(guesses=False), drawn).as_markdown()


def test_report_of_perfect_images_meets_every_target(drawn: Path) -> None:
    figures = _figures(replace(_judgement(), image=_judgement().truth))

    assert all(bar["met"] for bar in figures["bars"].values())
    assert "4 of 4 targets met" in document(figures, drawn).as_markdown()


@pytest.mark.parametrize("count", [1, 7])
def test_folder_is_complete_for_any_number_of_objects(tmp_path: Path, count: int) -> None:
    judgement = _judgement(count)
    out = tmp_path / "out"
    figures = _figures(judgement)
    write_report(out, judgement, figures)

    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "figures.json").read_text(encoding="utf-8")) == figures
    assert [row["name"] for row in _rows(out)] == judgement.names

    mean = np.mean([float(row["silhouette_iou"]) for row in _rows(out)])

    assert mean == pytest.approx(figures["silhouette_iou"]["value"], rel=1e-4)


def test_figures_separate_categories_left_out_of_training(drawn: Path) -> None:
    whole = _judgement()
    blind = np.array([kind == "kind 1" for kind in whole.categories])[:, None, None]
    image = np.where(blind, 0, whole.image)

    guessed = _figures(replace(whole, image=image, left_out=["kind 1", "kind 9"]))

    by = guessed["shown_and_left_out"]

    assert by["left out"]["silhouette_iou"]["value"] == 0
    assert by["shown"]["silhouette_iou"]["value"] > guessed["silhouette_iou"]["value"] > 0
    assert "left out" in document(guessed, drawn).as_markdown()


@pytest.fixture
def with_second_set() -> Evaluation:
    """An evaluation of objects of known kinds, and of two of kinds never seen."""
    whole = _judgement(3)
    kinds = [object_depth(seed, BOX)[0] for seed in range(3)]
    truth = whole.truth[:2]
    unseen = Unseen(["a", "b"], truth, np.zeros_like(truth))
    return replace(whole, categories=kinds, unseen=unseen)


def test_second_set_has_its_figures(with_second_set: Evaluation) -> None:
    unseen = _figures(with_second_set)["unseen"]

    assert unseen["silhouette_iou"]["value"] == 0
    assert unseen["objects"] == 2


def test_recognition_has_its_figures(with_second_set: Evaluation) -> None:
    assert _figures(with_second_set)["recognised"]["truth"]["value"] == 1


@pytest.mark.usefixtures("undrawn")
def test_second_set_and_recognition_are_reported(
    tmp_path: Path, with_second_set: Evaluation
) -> None:
    text = _written(tmp_path / "out", with_second_set)

    assert {path.name for path in (tmp_path / "out").iterdir()} == {*FILES, "sheet-unseen.png"}
    _written(tmp_path / "out", _judgement(3))

    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    assert "2 objects of kinds that training never sees" in text
    assert "recognised as their kind" in text


@pytest.mark.usefixtures("undrawn")
def test_interrupted_write_leaves_earlier_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.md").write_text("earlier")
    monkeypatch.setattr(report.pictures, "draw_gallery", Mock(side_effect=KeyboardInterrupt))

    with pytest.raises(KeyboardInterrupt):
        write_report(out, _judgement(3), {})

    assert {path.name: path.read_text() for path in out.iterdir()} == {"report.md": "earlier"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_object_without_value_has_an_empty_field(tmp_path: Path) -> None:
    whole = _judgement(2, guesses=False)
    blank = replace(whole, image=0 * whole.truth)
    figures = _figures(blank)

    write_report(tmp_path / "out", blank, figures)

    assert {row["foreground_rmse_mm"] for row in _rows(tmp_path / "out")} == {""}
    assert format_interval(figures["foreground_rmse_mm"]) == "none"


def test_report_of_one_object_has_no_interval(tmp_path: Path) -> None:
    one = _judgement(1)
    figures = _figures(one)

    write_report(tmp_path / "out", one, figures)

    assert figures["silhouette_iou"]["low"] is None
    assert "(one object: no interval)" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((0.6962, 0.6601, 0.7312), "0.696 (0.660 to 0.731)"),
        ((21.61, 19.3, 24.2), "21.6 (19.3 to 24.2)"),
        ((116.4, 96.0, 137.0), "116 (96 to 137)"),
        ((0.0, 0.0, 0.0), "0.000 (0.000 to 0.000)"),
        ((0.5, None, None), "0.500 (one object: no interval)"),
    ],
)
def test_interval_has_two_digits_of_its_half_width(
    values: tuple[float, float | None, float | None], text: str
) -> None:
    assert format_interval(Interval(*values)) == text
