"""The pictures of a judgement: every object is on the sheet, and what is drawn is what was judged."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlos_cam import evaluate_pictures
from nlos_cam.evaluate import BARS, over_objects
from nlos_cam.evaluate_pictures import ROWS, draw_categories, draw_gallery, draw_sheet


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are drawn."""
    made: list[Any] = []
    original = evaluate_pictures._figure

    def kept(size: tuple[float, float]) -> Any:
        made.append(original(size))
        return made[-1]

    monkeypatch.setattr(evaluate_pictures, "_figure", kept)
    return made


def _images(count: int) -> np.ndarray:
    return np.random.default_rng(count).random((count, 64, 64)).astype(np.float32)


def _shown(figure: Any) -> dict[str, Any]:
    """The first picture below each title."""
    return {axis.get_title(): np.asarray(axis.images[0].get_array()) for axis in figure.axes if axis.get_title()}


@pytest.mark.parametrize("count", [1, 4, 54])
def test_a_sheet_shows_truth_reconstruction_and_difference_of_every_object(
    tmp_path: Path, figures: list[Any], count: int
) -> None:
    truth, image = _images(count), _images(count)[::-1].copy()
    names = [f"object {k}" for k in range(count)]
    draw_sheet(tmp_path / "sheet.png", image, truth, names)
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")
    shown = _shown(figures[0])
    assert list(shown) == names
    np.testing.assert_array_equal(shown[names[-1]], truth[-1])
    drawn = [np.asarray(axis.images[0].get_array()) for axis in figures[0].axes if axis.images]
    for picture in (truth[0], image[0], image[0] - truth[0]):
        assert any(one.shape == picture.shape and np.array_equal(one, picture) for one in drawn)
    assert {text.get_text() for axis in figures[0].axes for text in axis.texts} == set(ROWS)


def test_of_very_many_objects_some_from_first_to_last_are_shown(tmp_path: Path, figures: list[Any]) -> None:
    draw_sheet(tmp_path / "sheet.png", _images(130), _images(130), [str(k) for k in range(130)])
    shown = [int(name) for name in _shown(figures[0])]
    assert (len(shown), shown[0], shown[-1]) == (54, 0, 129)
    assert shown == sorted(set(shown))


def test_the_gallery_has_the_worst_and_the_best(tmp_path: Path, figures: list[Any]) -> None:
    iou = np.random.default_rng(0).permutation(20) / 20
    draw_gallery(tmp_path / "gallery.png", _images(20), _images(20), [str(k) for k in range(20)], iou)
    titles = [name.splitlines()[0] for name in _shown(figures[0])]
    order = [str(k) for k in np.argsort(iou)]
    assert titles == [*order[:6], *order[::-1][:6]]


def test_categories_are_drawn_from_worst_to_best_with_estimate_and_wanted(tmp_path: Path, figures: list[Any]) -> None:
    values = {kind: {name: np.array([level, level]) for name in BARS} for kind, level in (("cup", 0.9), ("hat", 0.5))}
    by = {kind: over_objects(value) for kind, value in values.items()}
    draw_categories(tmp_path / "categories.png", by, by["cup"])
    axis = figures[0].axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["hat", "cup"]
    assert {text.get_text() for text in axis.get_legend().texts} == {"all objects: 0.9", "wanted: 0.9"}


def test_categories_without_a_value_are_left_empty(tmp_path: Path) -> None:
    nothing = {"cup": over_objects({name: np.array([np.nan]) for name in BARS})}
    draw_categories(tmp_path / "categories.png", nothing, nothing["cup"])
    assert (tmp_path / "categories.png").read_bytes().startswith(b"\x89PNG")
