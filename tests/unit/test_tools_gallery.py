"""The gallery's tables and picture."""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def gallery(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("gallery")


def figures(value: float) -> dict[str, dict[str, float]]:
    names = "silhouette_iou", "accuracy_mean_abs", "accuracy_within_2_percent", "foreground_rmse_mm"
    return {name: {"value": value, "low": value - 0.1, "high": value + 0.1} for name in names}


def test_the_worst_kind_comes_first_and_the_bar_last(gallery: ModuleType) -> None:
    table = gallery.by_kind({**figures(0.5), "per_category": {"cup": figures(0.8), "car": figures(0.2)}})
    names = [line.split(" | ")[0] for line in table.splitlines()[2:]]
    assert names == ["| car", "| cup", "| **all 54**", "| **the bar**"]


def test_tables_take_the_place_of_those_before_them_and_of_nothing_else(gallery: ModuleType) -> None:
    page = "a\n<!-- by kind -->\n<!-- end -->\nb\n<!-- by limit -->\nold\n<!-- end -->\nc\n"
    tables = {"by kind": "1\n", "by limit": "2\n"}
    filled = gallery.filled(page, tables)
    assert filled == "a\n<!-- by kind -->\n1\n<!-- end -->\nb\n<!-- by limit -->\n2\n<!-- end -->\nc\n"
    assert gallery.filled(filled, tables) == filled


def test_the_page_has_the_figures_that_were_measured(gallery: ModuleType) -> None:
    measured, limits = (
        json.loads((DOCS / name).read_text(encoding="utf-8")) for name in ("figures.json", "limits.json")
    )
    tables = {"by kind": gallery.by_kind(measured), "by limit": gallery.by_limit(limits)}
    page = gallery.PAGE.read_text(encoding="utf-8")
    assert gallery.filled(page, tables) == page, "run `python tools/gallery.py --tables`"


def test_things_unlike_training_lie_in_the_box_and_the_last_is_nothing(gallery: ModuleType) -> None:
    *things, nothing = gallery.unlike_training()
    assert np.isnan(nothing.depth_m).all()
    for thing in things:
        assert thing.depth_m.shape == (64, 64)
        assert 0.12 <= np.nanmin(thing.depth_m) <= np.nanmax(thing.depth_m) <= 0.4


def test_the_picture_has_a_column_for_each(gallery: ModuleType, tmp_path: Path) -> None:
    subjects = gallery.unlike_training()[-2:]
    image = truth = np.stack([np.eye(64, dtype=np.float32), np.zeros((64, 64), np.float32)])
    gallery.draw(tmp_path / "a.png", [("a row", subjects, image, truth, np.array([1.0, np.nan]))])
    assert (tmp_path / "a.png").stat().st_size > 1000
