"""Metrics by name (v in [0, 1], background where v < 0.05); one value per object.

Metrics of colour images (n, 3, 64, 64) with v in [0, 1], black background; one value per object.
"""

import numpy as np
from numpy.typing import NDArray

from nlos_models.arrays import Float32, Float64

BACKGROUND_BELOW_V = 0.05
CLOSE = 0.02
MIN_V = 0.1
"""v of the farthest surface (z_far)."""


def surface(image: Float32) -> NDArray[np.bool_]:
    """Where an image (..., 64, 64) shows a surface."""
    return image >= BACKGROUND_BELOW_V


def accuracy_mean_abs(image: Float32, truth: Float32) -> Float64:
    """1 - mean |v - v_true| over all pixels, (n,)."""
    return 1.0 - np.abs(image.astype(np.float64) - truth).mean((-2, -1))


def accuracy_within_2_percent(image: Float32, truth: Float32) -> Float64:
    """Share of all pixels with |v - v_true| <= 0.02, (n,)."""
    return (np.abs(image - truth) <= CLOSE).mean((-2, -1))


def silhouette_iou(image: Float32, truth: Float32) -> Float64:
    """Intersection over union of the surface masks, (n,); 1 where both are empty."""
    mine, its = surface(image), surface(truth)
    union = (mine | its).sum((-2, -1))
    return np.where(union > 0, (mine & its).sum((-2, -1)) / np.maximum(union, 1), 1.0)


def foreground_rmse_mm(image: Float32, truth: Float32, mm_per_v: float) -> Float64:
    """RMSE of depth over pixels that are surface in both, (n,); NaN where they share none.

    Depth is what `live` shows: a v between background's and MIN_V is at z_far.
    """
    both = surface(image) & surface(truth)
    apart = np.maximum(image.astype(np.float64), MIN_V) - np.maximum(truth, MIN_V)
    squares = np.where(both, np.square(apart), 0.0).sum((-2, -1))
    count = both.sum((-2, -1))
    return np.where(count > 0, mm_per_v * np.sqrt(squares / np.maximum(count, 1)), np.nan)


BLACK_V = 0.1
"""v of a channel that a surface does not reflect at all; background is 0."""
SMALLER_IS_BETTER = frozenset({"root_mean_square_error", "colour_error"})


def brightness(image: Float32) -> Float32:
    """The brightest channel (..., 64, 64) of colour images (..., 3, 64, 64): it says where there is a surface."""
    return image.max(-3)


def colour_silhouette_iou(image: Float32, truth: Float32) -> Float64:
    """`silhouette_iou` of what is not black, (n,)."""
    return silhouette_iou(brightness(image), brightness(truth))


def colour_accuracy_mean_abs(image: Float32, truth: Float32) -> Float64:
    """1 - mean |v - v_true| over all pixels and channels, (n,)."""
    return accuracy_mean_abs(image, truth).mean(-1)


def root_mean_square_error(image: Float32, truth: Float32) -> Float64:
    """RMS of v - v_true over all pixels and channels, (n,): of all that is the same for every object, the mean wins."""
    return np.sqrt(np.square(image.astype(np.float64) - truth).mean((-3, -2, -1)))


def colour_error(image: Float32, truth: Float32) -> Float64:
    """Mean |albedo - its truth| over channels and pixels that are surface in both, (n,); NaN where they share none."""
    both = surface(brightness(image)) & surface(brightness(truth))
    apart = np.abs(np.maximum(image, BLACK_V).astype(np.float64) - np.maximum(truth, BLACK_V)) / (1 - BLACK_V)
    count = both.sum((-2, -1))
    total = np.where(both, apart.mean(-3), 0.0).sum((-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def colour_metrics(image: Float32, truth: Float32) -> dict[str, Float64]:
    """Every metric of colour by name, each (n,)."""
    return {
        "silhouette_iou": colour_silhouette_iou(image, truth),
        "accuracy_mean_abs": colour_accuracy_mean_abs(image, truth),
        "root_mean_square_error": root_mean_square_error(image, truth),
        "colour_error": colour_error(image, truth),
    }
