"""Metrics by name (v in [0, 1], background where v < 0.05); one value per object."""

import numpy as np
from numpy.typing import NDArray

from nlos_models.arrays import Float32, Float64

BACKGROUND_BELOW_V = 0.05
CLOSE = 0.02
LEAST_V = 0.1
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

    Depth is what `live` shows: a v between background's and LEAST_V is at z_far.
    """
    both = surface(image) & surface(truth)
    apart = np.maximum(image.astype(np.float64), LEAST_V) - np.maximum(truth, LEAST_V)
    squares = np.where(both, np.square(apart), 0.0).sum((-2, -1))
    count = both.sum((-2, -1))
    return np.where(count > 0, mm_per_v * np.sqrt(squares / np.maximum(count, 1)), np.nan)
