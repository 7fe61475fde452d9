"""Figures of an evaluation: every object is on the sheet, in the colors of its values."""

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
    draw_gallery,
    draw_sheet,
)
from nlos_cam.evaluate.metrics import TARGETS, over_objects


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are drawn."""
    made = list[Any]()
    original = evaluate_pictures.figure_of
    monkeypatch.setattr(
        evaluate_pictures, "figure_of", lambda *size: made.append(original(*size)) or made[-1]
    )
    return made


def _images(count: int) -> np.ndarray:
    return np.random.default_rng(count).random((count, 64, 64)).astype(np.float32)


def _titles(figure: Any) -> list[str]:
    return [
        text.get_text()
        for axis in figure.axes
        for text in axis.texts
        if text.get_text() not in ROWS
    ]


def test_mosaic_shows_truth_reconstruction_and_difference() -> None:
    truth = _images(5)
    image = _images(5)[::-1].copy()
    canvas = evaluate_pictures.mosaic(image, truth, columns=3)

    assert canvas.shape == (2 * BLOCK, 3 * TILE, 3)

    for k in range(5):
        top = k // 3 * BLOCK + HEAD
        left = k % 3 * TILE
        tiles = [canvas[top + row * TILE :, left:][:64, :64] for row in range(3)]
        rows = zip(
            tiles,
            (truth[k], image[k], image[k] - truth[k]),
            (VALUE, VALUE, DIFFERENCE),
            strict=True,
        )
        for tile, picture, (name, low, high) in rows:
            expected = colormaps[name]((picture - low) / (high - low), bytes=True)[..., :3].astype(
                int
            )
            assert np.abs(expected - tile).max() <= 3

    assert (canvas[BLOCK:, 2 * TILE :] == 255).all()


@pytest.mark.parametrize("count", [1, 4, 7, pytest.param(54, marks=pytest.mark.slow), 130])
def test_sheet_names_up_to_54_objects_without_overlap(
    tmp_path: Path, figures: list[Any], count: int
) -> None:
    names = [f"headphones {2_000_000_000 + k}" for k in range(count)]
    draw_sheet(tmp_path / "sheet.png", _images(count), _images(count), names)

    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")

    shown = [int(title.removeprefix("headphones ")) for title in _titles(figures[0])]

    assert len(shown) == min(count, 54)
    assert shown[0] == 0
    assert shown[-1] == count - 1
    assert shown == sorted(set(shown))

    axis, *bars = figures[0].axes
    boxes = [text.get_window_extent() for text in axis.texts if text.get_text() not in ROWS]

    assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])
    assert max(box.x1 for box in boxes) < min(bar.get_window_extent().x0 for bar in bars)


@pytest.mark.parametrize("count", [1, 2, 5, 20])
def test_gallery_shows_the_worst_and_the_best_each_once(
    tmp_path: Path, figures: list[Any], count: int
) -> None:
    iou = np.random.default_rng(0).permutation(count) / 20
    names = [f"hat {2_000_000_000 + k}" for k in range(count)]
    draw_gallery(tmp_path / "gallery.png", _images(count), _images(count), names, iou)
    order = [f"hat {k}\nIoU {iou[k]:.2f}" for k in np.argsort(iou)]
    worst = min(6, -(-count // 2))

    assert _titles(figures[0]) == [*order[:worst], *order[worst:][::-1][:6]]


def test_categories_are_drawn_from_worst_to_best(tmp_path: Path, figures: list[Any]) -> None:
    levels = {"cup": 0.9, "hat": 0.5}
    by = {
        kind: over_objects({name: np.array([level] * 2) for name in TARGETS})
        for kind, level in levels.items()
    }
    evaluate_pictures.draw_categories(tmp_path / "categories.png", by, by["cup"])
    axis = figures[0].axes[0]

    assert [label.get_text() for label in axis.get_yticklabels()] == ["hat", "cup"]
    assert [text.get_text().count("0.9") for text in axis.get_legend().texts] == [
        1,
        1,
    ]  # the estimate and the bar

    nothing = {"cup": over_objects({name: np.array([np.nan]) for name in TARGETS})}
    evaluate_pictures.draw_categories(tmp_path / "empty.png", nothing, nothing["cup"])

    assert (tmp_path / "empty.png").read_bytes().startswith(b"\x89PNG")
