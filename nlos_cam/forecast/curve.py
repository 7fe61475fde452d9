"""From the linear estimate's IoU to a trained network's: one monotone curve, fitted to figures."""

import numpy as np

LINEAR = (0.46, 0.75)
NETWORK = (0.39, 0.79)
"""Ends of the curve: a guess, and the home rig."""
NETWORK_GUESS = NETWORK[0]


SCATTER_IOU = 0.05


def network_iou(linear_iou: float) -> float:
    """Return the silhouette IoU to expect of a network trained for the rig."""
    slope = (NETWORK[1] - NETWORK[0]) / (LINEAR[1] - LINEAR[0])
    return float(np.clip(NETWORK[0] + slope * (linear_iou - LINEAR[0]), 0, 1))
