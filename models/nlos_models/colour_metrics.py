"""Metrics of colour images (n, 3, 64, 64) with v in [0, 1], black background; one value per object."""

import numpy as np

from nlos_models.metrics import Images, Values, accuracy_mean_abs, silhouette_iou, surface

BLACK_V = 0.1
"""v of a channel that a surface does not reflect at all; background is 0."""
SMALLER_IS_BETTER = frozenset({"root_mean_square_error", "colour_error"})


def brightness(image: Images) -> Images:
    """The brightest channel (..., 64, 64) of colour images (..., 3, 64, 64): it says where there is a surface."""
    return image.max(-3)


def colour_silhouette_iou(image: Images, truth: Images) -> Values:
    """`silhouette_iou` of what is not black, (n,)."""
    return silhouette_iou(brightness(image), brightness(truth))


def colour_accuracy_mean_abs(image: Images, truth: Images) -> Values:
    """1 - mean |v - v_true| over all pixels and channels, (n,)."""
    return accuracy_mean_abs(image, truth).mean(-1)


def root_mean_square_error(image: Images, truth: Images) -> Values:
    """RMS of v - v_true over all pixels and channels, (n,): of all that is the same for every object, the mean wins."""
    return np.sqrt(np.square(image.astype(np.float64) - truth).mean((-3, -2, -1)))


def colour_error(image: Images, truth: Images) -> Values:
    """Mean |albedo - its truth| over channels and pixels that are surface in both, (n,); NaN where they share none."""
    both = surface(brightness(image)) & surface(brightness(truth))
    apart = np.abs(np.maximum(image, BLACK_V).astype(np.float64) - np.maximum(truth, BLACK_V)) / (1 - BLACK_V)
    count = both.sum((-2, -1))
    total = np.where(both, apart.mean(-3), 0.0).sum((-2, -1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def colour_metrics(image: Images, truth: Images) -> dict[str, Values]:
    """Every metric of colour by name, each (n,)."""
    return {
        "silhouette_iou": colour_silhouette_iou(image, truth),
        "accuracy_mean_abs": colour_accuracy_mean_abs(image, truth),
        "root_mean_square_error": root_mean_square_error(image, truth),
        "colour_error": colour_error(image, truth),
    }
