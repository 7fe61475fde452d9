"""Metrics of reconstructed images with bootstrap intervals, per category and against baselines.

And the error against size and detail of the surface, and by zone of the image (SI 6).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import cv2
import nlos_models as models
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64
from numpy.typing import NDArray

PerObject = dict[str, Float64]
"""Values of every object (n,) by the metric's name."""

RESAMPLES = 2000
BLOCK = 2_000_000
TARGETS = {
    "silhouette_iou": 0.90,
    "accuracy_mean_abs": 0.98,
    "accuracy_within_2_percent": 0.92,
    "foreground_rmse_mm": 8.0,
}
"""The project's targets on the 54 test objects: lower limits, of the last metric an upper limit."""
SMALLER_IS_BETTER = frozenset({"foreground_rmse_mm"})


@dataclass(frozen=True)
class Interval:
    """Mean over objects and its bootstrap 95 % interval."""

    value: float | None
    """None if no object has a value (no reconstruction shares a pixel with its truth)."""
    low: float | None
    """None, like `high`, for fewer than two values: one object shows no spread."""
    high: float | None


Figures = dict[str, Interval]
"""Estimates by the metric's name."""


def mm_per_v(box: ObjectBox) -> float:
    """Return the depth in millimetres of one unit of v."""
    return 1000 * (box.z_far_m - box.z_near_m) / (1 - models.MIN_V)


def per_object(image: Float32, truth: Float32, box: ObjectBox) -> PerObject:
    """Return every metric of images (n, 64, 64), per object."""
    return {
        "silhouette_iou": models.silhouette_iou(image, truth),
        "accuracy_mean_abs": models.accuracy_mean_abs(image, truth),
        "accuracy_within_2_percent": models.accuracy_within_2_percent(image, truth),
        "foreground_rmse_mm": models.foreground_rmse_mm(image, truth, mm_per_v(box)),
    }


def plain(figures: Figures) -> dict[str, dict[str, float | None]]:
    """Return figures ready for JSON: {value, low, high} by the metric's name."""
    return {name: asdict(figure) for name, figure in figures.items()}


def by_object(values: Mapping[str, Float64], of_object: NDArray[np.int64]) -> PerObject:
    """Return the mean of each metric over the frames of every object; `of_object` (n,) are the
    objects of the frames, numbered from 0.

    Frames of one object differ by their noise alone: only objects may be resampled for an interval.
    """
    found: PerObject = {}
    for name, value in values.items():
        known = ~np.isnan(value)
        count = np.bincount(of_object, known)
        total = np.bincount(of_object, np.where(known, value, 0.0))
        found[name] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return found


def over_objects(values: Mapping[str, Float64]) -> Figures:
    """Return the mean of each metric over objects with its interval."""
    return {name: interval(value) for name, value in values.items()}


def judge(image: Float32, truth: Float32, box: ObjectBox) -> Figures:
    """Return every metric of images (n, 64, 64) over all objects."""
    return over_objects(per_object(image, truth, box))


def per_category(values: Mapping[str, Float64], categories: Sequence[str]) -> dict[str, Figures]:
    """Return the figures of each category, in the order of first appearance."""
    of = np.array(categories)
    return {
        category: over_objects({name: value[of == category] for name, value in values.items()})
        for category in dict.fromkeys(categories)
    }


def advantage(
    ours: Mapping[str, Float64],
    theirs: Mapping[str, Float64],
    smaller_is_better: Collection[str] = SMALLER_IS_BETTER,
) -> Figures:
    """Return the mean per-object advantage of ours over theirs; positive is better for every
    metric.

    The difference is significant if the interval excludes 0. Objects without a value in either are
    left out.
    """
    return {
        name: interval((-1 if name in smaller_is_better else 1) * (value - theirs[name]))
        for name, value in ours.items()
    }


def interval(values: Float64) -> Interval:
    """Return the mean of values (n,) and its bootstrap 95 % interval, without ends for one value;
    NaN are left out.
    """
    values = values[~np.isnan(values)]
    if not values.size:
        return Interval(None, None, None)
    if values.size == 1:  # every resample is that value, and would make it look certain
        return Interval(float(values[0]), None, None)
    means = np.concatenate([values[part].mean(1) for part in resampled(len(values))])
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float(values.mean()), float(low), float(high))


def resampled(count: int) -> Iterator[NDArray[np.int64]]:
    """Yield the object indices (k, count) of bootstrap resamples, RESAMPLES in all, from a fixed
    seed. A block of them holds at most about BLOCK indices, so that memory does not grow with the
    set.
    """
    random = np.random.default_rng(0)
    rows = max(BLOCK // count, 1)
    for start in range(0, RESAMPLES, rows):
        yield random.integers(0, count, (min(rows, RESAMPLES - start), count))


def meets(name: str, figure: Interval) -> bool:
    """Return True if the estimate of a metric meets its target."""
    if figure.value is None:
        return False
    return (
        figure.value <= TARGETS[name]
        if name in SMALLER_IS_BETTER
        else figure.value >= TARGETS[name]
    )


def targets_met(figures: Figures) -> dict[str, dict[str, Any]]:
    """Return each metric's target and whether the estimate meets it."""
    return {name: {"bar": bar, "met": meets(name, figures[name])} for name, bar in TARGETS.items()}


@dataclass(frozen=True)
class Predictions:
    """Predicted quality of n reconstructions, beside the true one."""

    low: Float64
    """(n,): 10 % quantile of the silhouette IoU."""
    iou: Float64
    """(n,): median."""
    high: Float64
    """(n,): 90 % quantile."""
    error_mm: Float64
    """(n,): expected mean absolute error of the depth."""
    trusted: NDArray[np.bool_]
    """(n,): the page shows the frame in green."""

    def where(self, chosen: NDArray[np.bool_]) -> "Predictions":
        """Return those of a mask (n,)."""
        return Predictions(**{name: values[chosen] for name, values in vars(self).items()})


class PredictedFrames(NamedTuple):
    """Predicted and true quality of n frames."""

    predicted: Predictions
    iou: Float64
    """(n,): true silhouette IoU."""
    of_object: NDArray[np.int64]
    """(n,): number of each frame's object."""

    def where(self, chosen: NDArray[np.bool_]) -> "PredictedFrames":
        """Return those of a mask (n,)."""
        return PredictedFrames(
            self.predicted.where(chosen), self.iou[chosen], self.of_object[chosen]
        )


QUALITY_TARGETS = {"correlation": 0.7, "trusted_good": 0.9}
"""Lower limits: correlation of predicted with true IoU, and share of trusted frames with an IoU of
GOOD_IOU.
"""


def quality_figures(frames: PredictedFrames) -> dict[str, Any]:
    """Return how well the IoU of frames was predicted, and how many trusted frames were good; None
    without any of them.
    """
    predicted = frames.predicted
    iou = frames.iou
    good = iou >= models.GOOD_IOU
    trusted = predicted.trusted
    known = len(iou) > 2 and np.ptp(iou) > 0 and np.ptp(predicted.iou) > 0
    return {
        "correlation": float(np.corrcoef(predicted.iou, iou)[0, 1]) if known else None,
        "mean_error": float(np.abs(predicted.iou - iou).mean()),
        "bias": float((predicted.iou - iou).mean()),
        "within_80_percent_interval": float(
            ((iou >= predicted.low) & (iou <= predicted.high)).mean()
        ),
        "good": float(good.mean()),
        "trusted": float(trusted.mean()),
        "trusted_objects": len(np.unique(frames.of_object[trusted])),
        "trusted_good": float(good[trusted].mean()) if trusted.any() else None,
        "targets": QUALITY_TARGETS,
    }


STEP_MM = 10.0
"""Depth difference above which neighbouring surface pixels have an edge between them."""
RIM_PIXELS = 2.0
BINS = 4
ZONES = ("core", "rim inside", "rim outside", "far background")


def surface_cm2(truth: Float32, box: ObjectBox) -> Float64:
    """Return the surface area in cm² of images (n, 64, 64) as seen from the wall, (n,)."""
    width_cm, height_cm = _pitch_cm(truth, box)
    return width_cm * height_cm * models.surface(truth).sum((-2, -1))


def detail_per_cm(truth: Float32, box: ObjectBox) -> Float64:
    """Return the length of all edges (outline, holes, depth steps) per area of surface in 1/cm,
    (n,).

    A square plate of side a has 4 / a. NaN without surface.
    """
    width_cm, height_cm = _pitch_cm(truth, box)
    padded = np.pad(truth, ((0, 0), (1, 1), (1, 1)))
    mask = models.surface(padded)
    step = STEP_MM / mm_per_v(box)
    beside, below = (
        (
            np.diff(mask, axis=axis)
            | (_both(mask, axis) & (np.abs(np.diff(padded, axis=axis)) > step))
        ).sum((-2, -1))
        for axis in (2, 1)
    )
    area = surface_cm2(truth, box)
    return np.where(
        area > 0, (beside * height_cm + below * width_cm) / np.maximum(area, 1e-9), np.nan
    )


def _both(mask: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """Return True where a pixel and its next neighbour along an axis are both in the mask."""
    first, second = (
        np.take(mask, np.arange(start, mask.shape[axis] - 1 + start), axis) for start in (0, 1)
    )
    return first & second


def _pitch_cm(truth: Float32, box: ObjectBox) -> tuple[float, float]:
    rows, columns = truth.shape[-2:]
    return 100 * (box.x_max_m - box.x_min_m) / columns, 100 * (box.y_max_m - box.y_min_m) / rows


@dataclass(frozen=True)
class Bin:
    """Objects within a range of size or detail, and their mean error."""

    low: float
    high: float
    objects: int
    error: Interval


def curve(measure: Float64, error: Float64, bins: int = BINS) -> list[Bin]:
    """Return the error over bins with equal counts of objects, in ascending order of `measure`
    (n,).
    """
    order = np.argsort(measure, kind="stable")
    parts = [part for part in np.array_split(order, bins) if part.size]
    return [
        Bin(float(measure[p].min()), float(measure[p].max()), len(p), interval(error[p]))
        for p in parts
    ]


def rank_correlation(measure: Float64, error: Float64) -> Interval:
    """Return Spearman's correlation of error with `measure`, 1 if the error grows with it; NaN are
    left out.

    None for fewer than three objects, or if either is constant. Resamples keep the ranks of the
    whole set.
    """
    ranks = _ranked_pairs(measure, error)
    if ranks is None:
        return Interval(None, None, None)
    found = [_correlation(ranks[:, part]) for part in resampled(ranks.shape[1])]
    low, high = np.nanquantile(np.concatenate(found), [0.025, 0.975])
    return Interval(float(_correlation(ranks[:, None])[0]), float(low), float(high))


def spearman(one: Float64, other: Float64) -> float | None:
    """Return Spearman's correlation of pairs (n,), without an interval; NaN are left out.

    None for fewer than three pairs, or if either is constant.
    """
    ranks = _ranked_pairs(one, other)
    return None if ranks is None else float(_correlation(ranks[:, None])[0])


def _ranked_pairs(one: Float64, other: Float64) -> Float64 | None:
    """Return the ranks (2, m) of the pairs without NaN; None where they have no correlation."""
    valid = ~(np.isnan(one) | np.isnan(other))
    if valid.sum() < 3 or np.ptp(one[valid]) == 0 or np.ptp(other[valid]) == 0:
        return None
    return np.stack([_ranks(values[valid]) for values in (one, other)])


def _ranks(values: Float64) -> Float64:
    """Return ranks from 0; equal values share their mean rank."""
    _, which, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count + 1) / 2)[which]


def _correlation(pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Pearson's correlation over the last axis of (2, m, n), as (m,)."""
    x, y = pairs - pairs.mean(-1, keepdims=True)
    scale = np.sqrt((x**2).sum(-1) * (y**2).sum(-1))
    return np.where(scale > 0, (x * y).sum(-1) / np.maximum(scale, 1e-12), np.nan)


@dataclass(frozen=True)
class Zone:
    """Share of pixels and of error of one zone, over all images."""

    share_of_pixels: float
    share_of_error: float | None
    """Share of the sum of |v - v_true|; None without any error."""


def error_by_zone(image: Float32, truth: Float32) -> dict[str, Zone]:
    """Divide the absolute error among core, inner and outer rim (two pixels each) and far
    background.
    """
    zones = np.stack([_zones(mask) for mask in models.surface(truth)])
    error = np.abs(image.astype(np.float64) - truth)
    total = error.sum()
    return {
        name: Zone(
            float((zones == k).mean()),
            float(error[zones == k].sum() / total) if total > 0 else None,
        )
        for k, name in enumerate(ZONES)
    }


def _zones(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the index in ZONES of every pixel; background surrounds the image."""
    inside, outside = (
        cv2.distanceTransform(
            np.pad(part.astype(np.uint8), 1, constant_values=beyond), cv2.DIST_L2, 5
        )[1:-1, 1:-1]
        for part, beyond in ((mask, 0), (~mask, 1))
    )
    near_surface = outside <= RIM_PIXELS if mask.any() else np.zeros_like(mask)
    return np.where(mask, np.where(inside > RIM_PIXELS, 0, 1), np.where(near_surface, 2, 3))
