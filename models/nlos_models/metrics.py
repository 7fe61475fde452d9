"""Image metrics, one value per object: of depth images v in [0, 1] (background below 0.05) and of
color images.
"""

import numpy as np
from numpy.typing import NDArray

from nlos_models.arrays import Float32, Float64

BACKGROUND_BELOW_V = 0.05
CLOSE = 0.02
MIN_V = 0.1
"""v of the farthest surface (z_far)."""
CUTS = 0.3, 0.34, 0.38, 0.42, 0.46, 0.5
"""Probabilities of a surface that an image may be cut at: the one with the largest expected overlap
is taken. Lower ones would cost more of the mean absolute error.
"""


def surface(image: Float32) -> NDArray[np.bool_]:
    """Return the mask of an image's surface, (..., 64, 64)."""
    return image >= BACKGROUND_BELOW_V


def accuracy_mean_abs(image: Float32, truth: Float32) -> Float64:
    """Return 1 - mean |v - v_true| over all pixels, (n,)."""
    return 1.0 - np.abs(image.astype(np.float64) - truth).mean((-2, -1))


def accuracy_within_2_percent(image: Float32, truth: Float32) -> Float64:
    """Return the share of all pixels with |v - v_true| <= 0.02, (n,)."""
    return (np.abs(image - truth) <= CLOSE).mean((-2, -1))


def silhouette_iou(image: Float32, truth: Float32) -> Float64:
    """Return intersection over union of the surface masks, (n,); 1 where both are empty."""
    found = surface(image)
    true = surface(truth)
    # Of two empty images the overlap is right, not undefined.
    union = (found | true).sum((-2, -1))
    return np.where(union > 0, (found & true).sum((-2, -1)) / np.maximum(union, 1), 1.0)


def foreground_rmse_mm(image: Float32, truth: Float32, mm_per_v: float) -> Float64:
    """Return the RMSE of depth over pixels with a surface in both, (n,); NaN where they share none.

    Depth as `live` shows it: v from 0.05 to MIN_V is at z_far.
    """
    # Where one has no surface the error is the silhouette's, which the IoU counts.
    both = surface(image) & surface(truth)
    apart = np.maximum(image.astype(np.float64), MIN_V) - np.maximum(truth, MIN_V)
    squares = np.where(both, np.square(apart), 0.0).sum((-2, -1))
    count = both.sum((-2, -1))
    return np.where(count > 0, mm_per_v * np.sqrt(squares / np.maximum(count, 1)), np.nan)


BLACK_V = 0.1
"""v of a surface's channel with an albedo of 0; background is 0."""
SMALLER_IS_BETTER = frozenset({"root_mean_square_error", "colour_error"})


def brightness(image: Float32) -> Float32:
    """Return the brightest channel (..., 64, 64) of color images (..., 3, 64, 64), which defines
    their surface.
    """
    return image.max(-3)


def color_silhouette_iou(image: Float32, truth: Float32) -> Float64:
    """Return `silhouette_iou` of the brightest channels, (n,)."""
    return silhouette_iou(brightness(image), brightness(truth))


def color_accuracy_mean_abs(image: Float32, truth: Float32) -> Float64:
    """Return 1 - mean |v - v_true| over all pixels and channels, (n,)."""
    return accuracy_mean_abs(image, truth).mean(-1)


def root_mean_square_error(image: Float32, truth: Float32) -> Float64:
    """Return the RMS of v - v_true over all pixels and channels, (n,); the mean object is its best
    constant answer.
    """
    # Squared, so that the mean image is the best constant answer and a baseline beats nothing for
    # free.
    return np.sqrt(np.square(image.astype(np.float64) - truth).mean((-3, -2, -1)))


def color_error(image: Float32, truth: Float32) -> Float64:
    """Return the mean |albedo error| over channels and pixels with surface in both, (n,); NaN where
    they share none.
    """
    both = surface(brightness(image)) & surface(brightness(truth))
    apart = np.abs(np.maximum(image, BLACK_V).astype(np.float64) - np.maximum(truth, BLACK_V)) / (
        1 - BLACK_V
    )
    count = both.sum((-2, -1))
    total = np.where(both, apart.mean(-3), 0.0).sum((-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def color_metrics(image: Float32, truth: Float32) -> dict[str, Float64]:
    """Return every color metric by name, each (n,)."""
    return {
        "silhouette_iou": color_silhouette_iou(image, truth),
        "accuracy_mean_abs": color_accuracy_mean_abs(image, truth),
        "root_mean_square_error": root_mean_square_error(image, truth),
        "colour_error": color_error(image, truth),
    }
