"""Judge images of hidden objects: every metric by name with its interval, per category, and against the baselines.

Error against what a surface is like (SI 6): its size, its detail, and where on the image the error sits.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64
from nlos_models import MIN_V, accuracy_mean_abs, accuracy_within_2_percent, foreground_rmse_mm, silhouette_iou, surface
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
    return 1000 * (box.z_far_m - box.z_near_m) / (1 - MIN_V)


def per_object(image: Float32, truth: Float32, box: ObjectBox) -> PerObject:
    """Every metric of images (n, 64, 64) against the truth."""
    return {
        "silhouette_iou": silhouette_iou(image, truth),
        "accuracy_mean_abs": accuracy_mean_abs(image, truth),
        "accuracy_within_2_percent": accuracy_within_2_percent(image, truth),
        "foreground_rmse_mm": foreground_rmse_mm(image, truth, mm_per_v(box)),
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


STEP_MM = 10.0
"""Neighbouring surface pixels that differ by more in depth have an edge between them."""
RIM_PIXELS = 2.0
BINS = 4
ZONES = ("core", "rim inside", "rim outside", "far background")


def surface_cm2(truth: Float32, box: ObjectBox) -> Float64:
    """How large the surface of images (n, 64, 64) is, seen from the wall, (n,)."""
    width_cm, height_cm = _pitch_cm(truth, box)
    return width_cm * height_cm * surface(truth).sum((-2, -1))


def detail_per_cm(truth: Float32, box: ObjectBox) -> Float64:
    """Length of the edges (outline, holes, steps in depth) for each area of surface, (n,); a large plate has least.

    A square plate of side a has 4 / a. NaN where there is no surface.
    """
    width_cm, height_cm = _pitch_cm(truth, box)
    padded = np.pad(truth, ((0, 0), (1, 1), (1, 1)))
    seen, step = surface(padded), STEP_MM / mm_per_v(box)
    beside, below = (
        (np.diff(seen, axis=axis) | (_both(seen, axis) & (np.abs(np.diff(padded, axis=axis)) > step))).sum((-2, -1))
        for axis in (2, 1)
    )
    area = surface_cm2(truth, box)
    return np.where(area > 0, (beside * height_cm + below * width_cm) / np.maximum(area, 1e-9), np.nan)


def _both(seen: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    first, second = (np.take(seen, np.arange(start, seen.shape[axis] - 1 + start), axis) for start in (0, 1))
    return first & second


def _pitch_cm(truth: Float32, box: ObjectBox) -> tuple[float, float]:
    """Width and height of a pixel."""
    rows, columns = truth.shape[-2:]
    return 100 * (box.x_max_m - box.x_min_m) / columns, 100 * (box.y_max_m - box.y_min_m) / rows


@dataclass(frozen=True)
class Bin:
    """Objects that are alike, and their error."""

    low: float
    high: float
    objects: int
    error: Interval


def curve(like: Float64, error: Float64, bins: int = BINS) -> list[Bin]:
    """Error over bins of equally many objects, from those with least of what `like` measures to those with most."""
    order = np.argsort(like, kind="stable")
    parts = [part for part in np.array_split(order, bins) if part.size]
    return [Bin(float(like[p].min()), float(like[p].max()), len(p), interval(error[p])) for p in parts]


def rank_correlation(like: Float64, error: Float64) -> Interval:
    """Spearman's: 1 where the error grows with what `like` measures, -1 where it falls; objects without one left out.

    None where fewer than three objects have both, or one of the two never varies. Resamples keep the ranks of all.
    """
    kept = ~(np.isnan(like) | np.isnan(error))
    if kept.sum() < 3 or np.ptp(like[kept]) == 0 or np.ptp(error[kept]) == 0:
        return Interval(None, None, None)
    ranks = np.stack([_ranks(values[kept]) for values in (like, error)])
    low, high = np.nanquantile(_correlation(ranks[:, resampled(ranks.shape[1])]), [0.025, 0.975])
    return Interval(float(_correlation(ranks[:, None])[0]), float(low), float(high))


def _ranks(values: Float64) -> Float64:
    """From 0; equal values share the mean of theirs."""
    _, which, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count + 1) / 2)[which]


def _correlation(pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pearson's over the last axis of (2, m, n), as (m,)."""
    x, y = pairs - pairs.mean(-1, keepdims=True)
    scale = np.sqrt((x**2).sum(-1) * (y**2).sum(-1))
    return np.where(scale > 0, (x * y).sum(-1) / np.maximum(scale, 1e-12), np.nan)


@dataclass(frozen=True)
class Zone:
    """A part of all images together."""

    share_of_pixels: float
    share_of_error: float | None
    """Of the sum of |v - v_true|; None where there is no error at all."""


def where_the_error_is(image: Float32, truth: Float32) -> dict[str, Zone]:
    """How the absolute error divides: well inside the true surface, its rim of two pixels, and outside likewise."""
    zones = np.stack([_zones(mask) for mask in surface(truth)])
    error = np.abs(image.astype(np.float64) - truth)
    total = error.sum()
    return {
        name: Zone(float((zones == k).mean()), float(error[zones == k].sum() / total) if total > 0 else None)
        for k, name in enumerate(ZONES)
    }


def _zones(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The index in ZONES of every pixel; beyond the image is background."""
    inside, outside = (
        cv2.distanceTransform(np.pad(part.astype(np.uint8), 1, constant_values=beyond), cv2.DIST_L2, 5)[1:-1, 1:-1]
        for part, beyond in ((mask, 0), (~mask, 1))
    )
    near_surface = outside <= RIM_PIXELS if mask.any() else np.zeros_like(mask)
    return np.where(mask, np.where(inside > RIM_PIXELS, 0, 1), np.where(near_surface, 2, 3))
