"""Metrics of colour images (n, 3, 64, 64) with v in [0, 1], black background; one value per object."""

import numpy as np

from nlos_models.arrays import Float32, Float64
from nlos_models.metrics import accuracy_mean_abs, silhouette_iou, surface

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
