"""The pictures of a judgement: every object is on the sheet, and what is drawn is what was judged."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import colormaps

from nlos_cam.evaluate import figures as evaluate_pictures
from nlos_cam.evaluate.figures import (
    BLOCK,
    DIFFERENCE,
    HEAD,
    ROWS,
    TILE,
    VALUE,
    draw_categories,
    draw_gallery,
    draw_sheet,
    mosaic,
)
from nlos_cam.evaluate.metrics import BARS, over_objects


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


def _words(figure: Any) -> list[str]:
    return [text.get_text() for axis in figure.axes for text in axis.texts]


def test_a_mosaic_holds_truth_reconstruction_and_difference_of_every_object_in_its_colours() -> None:
    truth, image = _images(5), _images(5)[::-1].copy()
    canvas = mosaic(image, truth, columns=3)
    assert canvas.shape == (2 * BLOCK, 3 * TILE, 3)
    for k in range(5):
        top, left = k // 3 * BLOCK + HEAD, k % 3 * TILE
        tiles = [canvas[top + row * TILE :, left:][:64, :64] for row in range(3)]
        for tile, picture, (name, low, high) in zip(
            tiles, (truth[k], image[k], image[k] - truth[k]), (VALUE, VALUE, DIFFERENCE), strict=True
        ):
            shares = (picture - low) / (high - low)
            expected = colormaps[name](shares, bytes=True)[..., :3].astype(int)
            assert np.abs(expected - tile).max() <= 3
    assert (canvas[BLOCK:, 2 * TILE :] == 255).all()


@pytest.mark.parametrize("count", [1, 4, 54])
def test_every_object_on_the_sheet_has_its_name(tmp_path: Path, figures: list[Any], count: int) -> None:
    names = [f"object {k}" for k in range(count)]
    draw_sheet(tmp_path / "sheet.png", _images(count), _images(count), names)
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")
    words = _words(figures[0])
    assert words[:count] == names
    assert set(words[count:]) == set(ROWS)


def test_of_very_many_objects_some_from_first_to_last_are_shown(tmp_path: Path, figures: list[Any]) -> None:
    draw_sheet(tmp_path / "sheet.png", _images(130), _images(130), [str(k) for k in range(130)])
    shown = [int(word) for word in _words(figures[0]) if word not in ROWS]
    assert (len(shown), shown[0], shown[-1]) == (54, 0, 129)
    assert shown == sorted(set(shown))


def test_the_gallery_has_the_worst_and_the_best(tmp_path: Path, figures: list[Any]) -> None:
    iou = np.random.default_rng(0).permutation(20) / 20
    draw_gallery(tmp_path / "gallery.png", _images(20), _images(20), [str(k) for k in range(20)], iou)
    order = [f"{k}: {iou[k]:.2f}" for k in np.argsort(iou)]
    assert [word for word in _words(figures[0]) if word not in ROWS] == [*order[:6], *order[::-1][:6]]


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
