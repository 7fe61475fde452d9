"""Where the surface ends, and how deep it is there: the last step from a decoded image to a hidden depth map.

A network trained on squared error answers with the mean of what could be there: near a silhouette, a fraction of the
surface's v. By the convention v < 0.05 nearly all of that would count as surface, and much too far away. So a pixel is
kept only if it reaches KEPT_SHARE of the brightest about it, and what is kept is lifted to the surface's own v.
"""

import torch
from torch import Tensor
from torch.nn import functional

from nlos_models.metrics import LEAST_V

WINDOW = 13
"""Pixels; about 5 cm in the paper's box."""
LIFT_WINDOW = 7
"""Pixels; about as wide as silhouettes are blurred."""
KEPT_SHARE = 0.4


def cut_silhouette(image: Tensor) -> Tensor:
    """Decoded images (n, channels, h, w) as hidden images: 0 for background; a pixel's brightest channel tells."""
    bright = image.amax(1, keepdim=True)
    brightest = functional.max_pool2d(bright, WINDOW, stride=1, padding=WINDOW // 2)
    kept = (bright >= KEPT_SHARE * brightest) & (bright >= LEAST_V)
    return torch.where(kept, image, torch.zeros_like(image))


def lift_edges(image: Tensor) -> Tensor:
    """Raise decoded images (n, 1, h, w) to the smoothed brightest of their surroundings; nothing gets darker."""
    pad = LIFT_WINDOW // 2
    brightest = functional.max_pool2d(image, LIFT_WINDOW, stride=1, padding=pad)
    return torch.maximum(image, functional.avg_pool2d(brightest, LIFT_WINDOW, 1, pad, count_include_pad=False))
