"""Figures of an evaluation: contact sheet (SI Figure S2), metrics per category, error against
surface, extremes.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32, Float64
from nlos_models import GOOD_IOU
from numpy.typing import NDArray

from nlos_cam.evaluate.metrics import (
    SMALLER_IS_BETTER,
    TARGETS,
    Bin,
    Figures,
    Interval,
    PredictedFrames,
)
from nlos_cam.report import figure_of

SHEET_COLUMNS = 18
MAX_PER_SHEET = 54
GALLERY = 6
SHEET_IN = 9.0
"""Width of a sheet of few objects."""
SEED = re.compile(r"\d{9,}")
MAX_TITLE = 18
DIFFERENCE_V = 0.5
"""Difference in v at the ends of the colour map; 0.1 is 31 mm in the paper's box."""
Scale = tuple[str, float, float]
"""Name of a colour map, and the values at its ends."""
VALUE: Scale = ("inferno", 0.0, 1.0)
DIFFERENCE: Scale = ("coolwarm", -DIFFERENCE_V, DIFFERENCE_V)
TILE = 70
HEAD = 16
"""Pixels from one object to the next, and above it for its name."""
BLOCK = HEAD + 3 * TILE
ROWS = "truth", "reconstruction", "difference"
LABELS = {
    "silhouette_iou": "silhouette IoU",
    "accuracy_mean_abs": "accuracy, mean abs",
    "accuracy_within_2_percent": "accuracy within 2 %",
    "foreground_rmse_mm": "foreground RMSE, mm",
}


def draw_sheet(path: Path, image: Float32, truth: Float32, titles: Sequence[str]) -> None:
    """Draw truth, reconstruction and difference of up to 54 objects, evenly chosen if there are
    more (SI Figure S2).
    """
    shown = np.unique(np.linspace(0, len(truth) - 1, min(len(truth), MAX_PER_SHEET)).astype(int))
    columns = min(SHEET_COLUMNS, len(shown))
    wide_in = min(max(SHEET_IN / columns, 0.8), 1.6)
    figure = figure_of(
        wide_in * columns + 1.8, BLOCK / TILE * wide_in * -(-len(shown) // columns) + 0.2
    )
    axis = figure.subplots()
    names = [short(titles[int(k)]) for k in shown]
    _mosaic(axis, image[shown], truth[shown], names, columns, wide_in)
    _color_bars(figure, axis)
    figure.savefig(path, dpi=100)


def draw_gallery(
    path: Path, image: Float32, truth: Float32, titles: Sequence[str], iou: Float64
) -> None:
    """Draw the objects with the lowest silhouette IoU above those with the highest, each object
    once.
    """
    order = np.argsort(iou, kind="stable")
    worst = min(GALLERY, -(-len(order) // 2))
    rows = {"worst": order[:worst], "best": order[::-1][: min(GALLERY, len(order) - worst)]}
    rows = {title: chosen for title, chosen in rows.items() if len(chosen)}
    figure = figure_of(1.5 * worst + 2, 5.2 * len(rows))
    axes = figure.subplots(len(rows), 1, squeeze=False)[:, 0]
    for axis, (title, chosen) in zip(axes, rows.items(), strict=True):
        _mosaic(
            axis,
            image[chosen],
            truth[chosen],
            [f"{short(titles[int(k)])}\nIoU {iou[k]:.2f}" for k in chosen],
            worst,
            1.5,
        )
        axis.set_title(f"{title} silhouettes", fontsize=11)
    _color_bars(figure, list(axes))
    figure.savefig(path, dpi=90)


def short(title: str) -> str:
    """Return a title that fits above its tile: of a held-out seed (2000000003) the last digits."""
    words = SEED.sub(lambda seed: str(int(seed[0]) % 10**6), title)
    return words if len(words) <= MAX_TITLE else f"{words[: MAX_TITLE - 1]}\N{HORIZONTAL ELLIPSIS}"


def _mosaic(
    axis: Any, image: Float32, truth: Float32, titles: Sequence[str], columns: int, wide_in: float
) -> None:
    """Draw truth, reconstruction and difference below each other as one image, each object
    `wide_in` inches wide, with titles of at most two lines.
    """
    size = min(7.5 * wide_in, 8.5)
    axis.imshow(mosaic(image, truth, columns))
    axis.set_axis_off()
    for k, title in enumerate(titles):
        block, column = divmod(k, columns)
        axis.text(
            column * TILE + 32,
            block * BLOCK + HEAD - 3,
            title,
            fontsize=size,
            ha="center",
            va="bottom",
        )
    for block in range(-(-len(titles) // columns)):
        for row, name in enumerate(ROWS):
            middle = block * BLOCK + HEAD + row * TILE + 32
            axis.text(-4, middle, name, fontsize=size, rotation=90, ha="right", va="center")


def mosaic(image: Float32, truth: Float32, columns: int) -> NDArray[np.uint8]:
    """Return the colored tiles (rows, columns, 3) of images (n, 64, 64): blocks of HEAD and three
    TILE rows.
    """
    canvas = np.full((-(-len(truth) // columns) * BLOCK, columns * TILE, 3), 255, np.uint8)
    rows = _colored(truth, VALUE), _colored(image, VALUE), _colored(image - truth, DIFFERENCE)
    for k in range(len(truth)):
        block, column = divmod(k, columns)
        for row, tiles in enumerate(rows):
            top = block * BLOCK + HEAD + row * TILE
            left = column * TILE
            canvas[top : top + 64, left : left + 64] = tiles[k]
    return canvas


def _mappable(scale: Scale) -> Any:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    name, low, high = scale
    return ScalarMappable(Normalize(low, high), name)


def _colored(images: Float32, scale: Scale) -> NDArray[np.uint8]:
    """Map images (n, 64, 64) to colors (n, 64, 64, 3)."""
    mapped = _mappable(scale)
    return mapped.cmap(mapped.norm(images), bytes=True)[..., :3]


def _color_bars(figure: Any, axes: Any) -> None:
    words = (
        (VALUE, "v: 0 background, 1 near the wall"),
        (DIFFERENCE, "difference in v: red is too near"),
    )
    for scale, label in words:
        figure.colorbar(_mappable(scale), ax=axes, fraction=0.015, pad=0.01).set_label(
            label, fontsize=8
        )


def draw_categories(path: Path, categories: Mapping[str, Figures], overall: Figures) -> None:
    """Draw each metric per category with its interval, the mean of all objects and the target."""
    ordered = sorted(categories, key=lambda name: categories[name]["silhouette_iou"].value or 0.0)
    figure = figure_of(13, 1.4 + 0.24 * len(ordered))
    for axis, (metric, label) in zip(
        figure.subplots(1, 4, sharey=True), LABELS.items(), strict=True
    ):
        _points(axis, [categories[name][metric] for name in ordered])
        if (mean := overall[metric].value) is not None:
            axis.axvline(mean, color="black", linewidth=1, label=f"all objects: {mean:.3g}")
        axis.axvline(
            TARGETS[metric],
            color="tab:green",
            linestyle="--",
            linewidth=1,
            label=f"target: {TARGETS[metric]:g}",
        )
        better = "lower" if metric in SMALLER_IS_BETTER else "higher"
        axis.set(
            title=label,
            xlabel=f"{better} is better",
            yticks=range(len(ordered)),
            yticklabels=ordered,
        )
        axis.legend(
            fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.6 / (1 + 0.24 * len(ordered)))
        )
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=90)


def _points(axis: Any, figures: Sequence[Interval]) -> None:
    """Draw estimates and intervals as points and lines: the axis does not begin at 0."""
    for k, figure in enumerate(figures):
        if figure.value is None:
            continue
        axis.plot(figure.value, k, "o", color="tab:blue")
        if figure.low is not None:
            axis.plot([figure.low, figure.high], [k, k], color="tab:blue", linewidth=2, alpha=0.6)


def draw_quality(path: Path, sets: Mapping[str, PredictedFrames]) -> None:
    """Draw the true IoU of each set's objects against the predicted one with its interval; trusted
    ones in green.
    """
    figure = figure_of(5 * len(sets), 4.6)
    for axis, (name, (predicted, iou, _)) in zip(
        figure.subplots(1, len(sets), squeeze=False)[0], sets.items(), strict=True
    ):
        axis.hlines(iou, predicted.low, predicted.high, colors="tab:blue", alpha=0.25)
        for chosen, color, label in (
            (~predicted.trusted, "tab:blue", "estimate"),
            (predicted.trusted, "tab:green", "shown in green"),
        ):
            axis.plot(
                predicted.iou[chosen], iou[chosen], "o", markersize=4, color=color, label=label
            )
        axis.plot([0, 1], [0, 1], "k:", label="perfect")
        axis.axhline(GOOD_IOU, color="tab:gray", linewidth=1, label=f"good: {GOOD_IOU:g}")
        axis.set(title=name, xlabel="predicted IoU", ylabel="true IoU", xlim=(0, 1), ylim=(0, 1))
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def draw_against_surface(
    path: Path,
    surfaces: Mapping[str, Float64],
    errors: Mapping[str, Float64],
    curves: Mapping[str, Mapping[str, list[Bin]]],
) -> None:
    """Draw each object's error against size and detail of its surface, and means over bins with
    equal counts.
    """
    figure = figure_of(11, 7.5)
    axes = figure.subplots(len(errors), len(surfaces), squeeze=False)
    for row, (error_name, error) in zip(axes, errors.items(), strict=True):
        for axis, (name, value) in zip(row, surfaces.items(), strict=True):
            axis.plot(value, error, "o", markersize=4, alpha=0.5, color="tab:blue", label="object")
            _curve(axis, curves[name][error_name])
            axis.set(xlabel=name, ylabel=error_name, ylim=(0, None))
            axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=90)


def _curve(axis: Any, bins: Sequence[Bin]) -> None:
    label = "mean of a bin, 95 % interval"
    for one in bins:
        error = one.error
        if error.value is None:
            continue
        axis.plot([one.low, one.high], [error.value] * 2, color="tab:red", linewidth=2, label=label)
        label = None
        if error.low is None:
            continue
        middle = (one.low + one.high) / 2
        axis.plot([middle] * 2, [error.low, error.high], color="tab:red", linewidth=1)
