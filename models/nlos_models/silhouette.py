"""Where the surface ends: the last step from a decoded image to a hidden depth map.

A network trained on squared error answers with the mean of what could be there: beside a silhouette, a fraction of the
surface's v. By the convention v < 0.05 nearly all of that would count as surface. So a pixel is kept only if it reaches
KEPT_SHARE of the brightest within the window about it.
"""

import torch
from torch import Tensor
from torch.nn import functional

WINDOW = 13
"""Pixels; about 5 cm in the paper's box."""
KEPT_SHARE = 0.4
LEAST_V = 0.1
"""v of the farthest surface (z_far)."""


def cut_silhouette(image: Tensor) -> Tensor:
    """Decoded images (n, 1, h, w) as hidden images: 0 for background, else 0.1 to 1."""
    brightest = functional.max_pool2d(image, WINDOW, stride=1, padding=WINDOW // 2)
    kept = (image >= KEPT_SHARE * brightest) & (image >= LEAST_V)
    return torch.where(kept, image, torch.zeros_like(image))
