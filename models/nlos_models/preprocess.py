"""Split-and-stack: (64, 80) lidar maps to the (4, 100, 100) that the compressor eats (SI 4).

Channels: left depth, right depth, left intensity, right intensity; left = columns 0 to 39, nearer the lidar.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

CHANNELS = ("left depth", "right depth", "left intensity", "right intensity")
LEFT = (0, 2)
RESIZED = 100
SMALLEST_SPREAD = 1e-6
"""A channel that never varies is divided by this, not by zero."""


def split_and_stack(depth_m: Tensor, intensity: Tensor) -> Tensor:
    """Maps (n, 64, 80) to (n, 4, 64, 40); a cell without a return (NaN depth) is NaN in both of its channels."""
    seen = torch.where(torch.isnan(depth_m), depth_m, intensity)
    half = depth_m.shape[-1] // 2
    return torch.stack([depth_m[..., :half], depth_m[..., half:], seen[..., :half], seen[..., half:]], dim=1)


def channel_statistics(stacked: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (4,) and standard deviation (4,) of stacked maps (n, 4, 64, 40) over the cells that have a return."""
    values = stacked.transpose(0, 1).flatten(1).double()
    seen = ~torch.isnan(values)
    count = seen.sum(1).clamp(min=1)
    mean = torch.where(seen, values, 0.0).sum(1) / count
    spread = torch.where(seen, values - mean[:, None], 0.0).square().sum(1) / count
    return mean.float(), spread.sqrt().float()


class Preprocess(nn.Module):
    """Normalise per channel, add SI 4's noise to the left channels while training, resize to 100 x 100."""

    mean: Tensor
    spread: Tensor

    def __init__(self, left_noise: float = 0.2) -> None:
        super().__init__()
        self.left_noise = left_noise
        self.register_buffer("mean", torch.zeros(len(CHANNELS)))
        self.register_buffer("spread", torch.ones(len(CHANNELS)))

    def learn(self, stacked: Tensor) -> None:
        """Take the statistics from training maps (n, 4, 64, 40)."""
        mean, spread = channel_statistics(stacked)
        self.mean.copy_(mean)
        self.spread.copy_(spread)

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Maps (n, 64, 80) to (n, 4, 100, 100); invalid cells take the channel's mean, which is 0 here."""
        stacked = split_and_stack(depth_m, intensity)
        scale = self.spread.clamp(min=SMALLEST_SPREAD)
        normal = (stacked - self.mean[:, None, None]) / scale[:, None, None]
        normal = torch.where(torch.isnan(normal), torch.zeros_like(normal), normal)
        if self.training:
            for channel in LEFT:
                normal[:, channel] += self.left_noise * torch.randn_like(normal[:, channel])
        return functional.interpolate(normal, (RESIZED, RESIZED), mode="bilinear", align_corners=False)
