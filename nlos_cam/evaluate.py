"""Judge images of hidden objects: every metric by name with its interval, per category, and against the baselines."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.rig import ObjectBox
from nlos_models import metrics
from numpy.typing import NDArray

PerObject = dict[str, Float64]
"""By the metric's name."""

RESAMPLES = 2000
BARS = {
    "silhouette_iou": 0.90,
    "accuracy_mean_abs": 0.98,
    "accuracy_within_2_percent": 0.92,
    "foreground_rmse_mm": 8.0,
}
"""What the project wants of each metric on the 54 test objects; of the last, at most so much."""
SMALLER_IS_BETTER = frozenset({"foreground_rmse_mm"})


@dataclass(frozen=True)
class Interval:
    """An estimate over objects and its bootstrap 95 % interval."""

    value: float | None
    """None where no object has a value (no reconstruction shares a pixel with its truth)."""
    low: float | None
    high: float | None


Figures = dict[str, Interval]
"""By the metric's name."""


def mm_per_v(box: ObjectBox) -> float:
    """Millimetres of depth that one unit of v stands for."""
    return 1000 * (box.z_far_m - box.z_near_m) / (1 - metrics.LEAST_V)


def per_object(image: Float32, truth: Float32, box: ObjectBox) -> PerObject:
    """Every metric of images (n, 64, 64) against the truth."""
    return {
        "silhouette_iou": metrics.silhouette_iou(image, truth),
        "accuracy_mean_abs": metrics.accuracy_mean_abs(image, truth),
        "accuracy_within_2_percent": metrics.accuracy_within_2_percent(image, truth),
        "foreground_rmse_mm": metrics.foreground_rmse_mm(image, truth, mm_per_v(box)),
    }


def plain(figures: Figures) -> dict[str, dict[str, float | None]]:
    """Figures ready for JSON: {value, low, high} by the metric's name."""
    return {name: asdict(figure) for name, figure in figures.items()}


def over_objects(values: Mapping[str, Float64]) -> Figures:
    """The mean of each metric over objects, with its interval."""
    return {name: interval(value) for name, value in values.items()}


def judge(image: Float32, truth: Float32, box: ObjectBox) -> Figures:
    """Every metric of images (n, 64, 64) against the truth, over all objects."""
    return over_objects(per_object(image, truth, box))


def per_category(values: Mapping[str, Float64], categories: Sequence[str]) -> dict[str, Figures]:
    """The figures of each category's objects alone, in the order of first appearance."""
    of = np.array(categories)
    return {
        category: over_objects({name: value[of == category] for name, value in values.items()})
        for category in dict.fromkeys(categories)
    }


def advantage(
    ours: Mapping[str, Float64], theirs: Mapping[str, Float64], smaller_is_better: Collection[str] = SMALLER_IS_BETTER
) -> Figures:
    """By how much ours is better, object by object: positive is better, also where less is better.

    An interval that excludes 0 tells them apart; objects that either has no value for are left out.
    """
    return {
        name: interval((-1 if name in smaller_is_better else 1) * (value - theirs[name]))
        for name, value in ours.items()
    }


def interval(values: Float64) -> Interval:
    """Mean over objects (n,) and its bootstrap 95 % interval; objects without a value are left out."""
    values = values[~np.isnan(values)]
    if not values.size:
        return Interval(None, None, None)
    means = values[resampled(len(values))].mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float(values.mean()), float(low), float(high))


def resampled(count: int) -> NDArray[np.int64]:
    """Which objects (RESAMPLES, count) each resample holds; always the same ones."""
    return np.random.default_rng(0).integers(0, count, (RESAMPLES, count))


def meets(name: str, figure: Interval) -> bool:
    """Whether the estimate of a metric meets its bar."""
    if figure.value is None:
        return False
    return figure.value <= BARS[name] if name in SMALLER_IS_BETTER else figure.value >= BARS[name]


def bars_met(figures: Figures) -> dict[str, dict[str, Any]]:
    """Each metric's bar, and whether its estimate meets it."""
    return {name: {"bar": bar, "met": meets(name, figures[name])} for name, bar in BARS.items()}
