"""Split-and-stack: (64, 80) lidar maps to the (4, 100, 100) that the compressor eats (SI 4).

Channels: left depth, right depth, left intensity, right intensity; left = columns 0 to 39, nearer the lidar. In
colour, which is simulation only, three intensities follow the depth: 8 channels.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

RESIZED = 100
SMALLEST_SPREAD = 1e-6
"""A channel that never varies is divided by this, not by zero."""


def stacked_channels(intensities: int = 1) -> int:
    """Left and right half of the depth and of each intensity."""
    return 2 * (1 + intensities)


def split_and_stack(depth_m: Tensor, intensity: Tensor) -> Tensor:
    """Depth (n, 64, 80), and intensity (n, 64, 80) or (n, k, 64, 80), to (n, 2 + 2 k, 64, 40): left, right in turn.

    A cell without a return (NaN depth) is NaN in all of its channels.
    """
    depth = depth_m[:, None]
    each = intensity[:, None] if intensity.ndim == depth_m.ndim else intensity
    maps = torch.cat([depth, torch.where(torch.isnan(depth), depth, each)], dim=1)
    half = depth_m.shape[-1] // 2
    return torch.stack([maps[..., :half], maps[..., half:]], dim=2).flatten(1, 2)


def channel_statistics(stacked: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (channels,) of stacked maps (n, channels, 64, 40) over the cells with a return."""
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

    def __init__(self, left_noise: float = 0.2, intensities: int = 1) -> None:
        super().__init__()
        self.left_noise = left_noise
        self.register_buffer("mean", torch.zeros(stacked_channels(intensities)))
        self.register_buffer("spread", torch.ones(stacked_channels(intensities)))

    def learn(self, stacked: Tensor) -> None:
        """Take the statistics from training maps (n, channels, 64, 40)."""
        mean, spread = channel_statistics(stacked)
        self.mean.copy_(mean)
        self.spread.copy_(spread)

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Maps (n, 64, 80) to (n, channels, 100, 100); invalid cells take the channel's mean, which is 0 here."""
        stacked = split_and_stack(depth_m, intensity)
        scale = self.spread.clamp(min=SMALLEST_SPREAD)
        normal = (stacked - self.mean[:, None, None]) / scale[:, None, None]
        normal = torch.where(torch.isnan(normal), torch.zeros_like(normal), normal)
        if self.training:
            for channel in range(0, normal.shape[1], 2):
                normal[:, channel] += self.left_noise * torch.randn_like(normal[:, channel])
        return functional.interpolate(normal, (RESIZED, RESIZED), mode="bilinear", align_corners=False)
