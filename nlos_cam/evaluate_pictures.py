"""Pictures of a judgement: SI 6's Figure S2 as a sheet, metrics per category, error against surface, worst and best."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nlos_cam.evaluate import BARS, SMALLER_IS_BETTER, Figures, Interval, Values
from nlos_cam.evaluate_surface import Bin
from nlos_cam.frames import Float32

SHEET_COLUMNS = 18
MOST_ON_A_SHEET = 54
GALLERY = 6
DIFFERENCE_V = 0.5
"""The difference that has the full colour; 0.1 is 31 mm in the paper's box."""
ROWS = "truth", "reconstruction", "difference"
LABELS = {
    "silhouette_iou": "silhouette IoU",
    "accuracy_mean_abs": "accuracy, mean abs",
    "accuracy_within_2_percent": "accuracy within 2 %",
    "foreground_rmse_mm": "foreground RMSE, mm",
}


def draw_sheet(path: Path, image: Float32, truth: Float32, titles: Sequence[str]) -> None:
    """Truth, reconstruction and difference of up to 54 objects, evenly chosen where there are more (Figure S2)."""
    shown = np.unique(np.linspace(0, len(truth) - 1, min(len(truth), MOST_ON_A_SHEET)).astype(int))
    columns = min(SHEET_COLUMNS, len(shown))
    blocks = [shown[k : k + columns] for k in range(0, len(shown), columns)]
    figure = _figure((0.9 * columns + 1.3, 2.95 * len(blocks) + 0.2))
    axes = figure.subplots(3 * len(blocks), columns, squeeze=False)
    drawn: list[Any] = []
    for axis in axes.ravel():
        axis.set_axis_off()
    for at, block in enumerate(blocks):
        for column, k in enumerate(block):
            drawn = _three(axes[3 * at : 3 * at + 3, column], image[k], truth[k])
            axes[3 * at, column].set_title(titles[k], fontsize=8, pad=2)
        for offset, name in enumerate(ROWS):
            axes[3 * at + offset, 0].text(-8, 32, name, fontsize=8, rotation=90, ha="center", va="center")
    _colour_bars(figure, axes, drawn)
    figure.savefig(path, dpi=90)


def _figure(size: tuple[float, float]) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _three(axes: Any, image: Float32, truth: Float32) -> list[Any]:
    """Truth, reconstruction, difference, one below the other or side by side."""
    looks = (
        (truth, "magma", (0, 1)),
        (image, "magma", (0, 1)),
        (image - truth, "coolwarm", (-DIFFERENCE_V, DIFFERENCE_V)),
    )
    return [
        axis.imshow(picture, cmap=colours, vmin=low, vmax=high)
        for axis, (picture, colours, (low, high)) in zip(axes, looks, strict=True)
    ]


def _colour_bars(figure: Any, axes: Any, drawn: Sequence[Any]) -> None:
    some, label = list(axes.ravel()), {"fontsize": 8}
    figure.colorbar(drawn[0], ax=some, fraction=0.015, pad=0.005).set_label("v: 0 background, 1 near the wall", **label)
    figure.colorbar(drawn[2], ax=some, fraction=0.015, pad=0.005).set_label("difference in v: red is too near", **label)


def draw_categories(path: Path, categories: Mapping[str, Figures], overall: Figures) -> None:
    """Each metric per category with its interval, beside the mean of all objects and the bar."""
    ordered = sorted(categories, key=lambda name: categories[name]["silhouette_iou"].value or 0.0)
    figure = _figure((13, 1.4 + 0.24 * len(ordered)))
    for axis, (metric, label) in zip(figure.subplots(1, 4, sharey=True), LABELS.items(), strict=True):
        _points(axis, [categories[name][metric] for name in ordered])
        if (mean := overall[metric].value) is not None:
            axis.axvline(mean, color="black", linewidth=1, label=f"all objects: {mean:.3g}")
        axis.axvline(BARS[metric], color="tab:green", linestyle="--", linewidth=1, label=f"wanted: {BARS[metric]:g}")
        better = "less" if metric in SMALLER_IS_BETTER else "more"
        axis.set(title=label, xlabel=f"{better} is better", yticks=range(len(ordered)), yticklabels=ordered)
        axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.6 / (1 + 0.24 * len(ordered))))
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=90)


def _points(axis: Any, figures: Sequence[Interval]) -> None:
    """Estimates and intervals; no bars, since the axis does not begin at 0."""
    for k, figure in enumerate(figures):
        if figure.value is not None:
            axis.plot([figure.low, figure.high], [k, k], color="tab:blue", linewidth=2, alpha=0.6)
            axis.plot(figure.value, k, "o", color="tab:blue")


def draw_against_surface(
    path: Path, like: Mapping[str, Values], errors: Mapping[str, Values], curves: Mapping[str, Mapping[str, list[Bin]]]
) -> None:
    """Every object's error against each measure of its surface, and the mean over bins of equally many objects."""
    figure = _figure((11, 7.5))
    axes = figure.subplots(len(errors), len(like), squeeze=False)
    for row, (error_name, error) in zip(axes, errors.items(), strict=True):
        for axis, (like_name, value) in zip(row, like.items(), strict=True):
            axis.plot(value, error, "o", markersize=4, alpha=0.5, color="tab:blue", label="an object")
            _curve(axis, curves[like_name][error_name])
            axis.set(xlabel=like_name, ylabel=error_name, ylim=(0, None))
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
        axis.plot([(one.low + one.high) / 2] * 2, [error.low, error.high], color="tab:red", linewidth=1)
        label = None


def draw_gallery(path: Path, image: Float32, truth: Float32, titles: Sequence[str], iou: Values) -> None:
    """The objects with the lowest silhouette IoU above those with the highest, with their figures."""
    order = np.argsort(iou, kind="stable")
    count = min(GALLERY, len(order))
    figure = _figure((1.75 * count + 1.2, 10.6))
    parts = figure.subfigures(2, 1)
    for part, chosen, title in zip(parts, (order[:count], order[::-1][:count]), ("worst", "best"), strict=True):
        part.suptitle(f"{title} silhouettes", fontsize=11)
        axes = part.subplots(3, count, squeeze=False)
        drawn: list[Any] = []
        for column, k in enumerate(chosen):
            drawn = _three(axes[:, column], image[k], truth[k])
            axes[0, column].set_title(f"{titles[k]}\nIoU {iou[k]:.2f}", fontsize=9)
        for axis in axes.ravel():
            axis.set_axis_off()
        for axis, name in zip(axes[:, 0], ROWS, strict=True):
            axis.text(-5, 32, name, fontsize=9, rotation=90, ha="center", va="center")
        _colour_bars(part, axes, drawn)
    figure.savefig(path, dpi=90)
