"""From the linear estimate's IoU to a trained network's: one line, fitted to networks' figures by
`tools/studies/forecast.py rigs`.
"""

import numpy as np

FORECAST_VERSION = 1
"""Version of the figures that benches keep of a forecast: raise it with the line, or with what they
are made from, and `predict` makes them again."""
SLOPE = 1.320
OFFSET = -0.221
SCATTER_IOU = 0.08
"""Error to state of a forecast: more than the largest of a rig that the line was not fitted to,
0.064 (root mean square 0.03), since most of these rigs are near the home rig."""


def network_iou(linear_iou: float) -> float:
    """Return the silhouette IoU to expect of a network trained for the rig."""
    return float(np.clip(OFFSET + SLOPE * linear_iou, 0, 1))
