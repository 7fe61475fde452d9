"""The colour compressor: ResNet50 with 8 input channels and 512 outputs (SI 4; 24,572,800 parameters).

Bottlenecks 3-4-6-3 as published (He et al., "Deep Residual Learning for Image Recognition", 2015, table 1), with the
stride in the 3 x 3 convolution, as it is commonly built: the parameters are the same. SI's 24,557,120 is the count for
3 inputs.
"""

import torch
from torch import Tensor, nn

from nlos_models.compressor import conv_norm

INPUT_CHANNELS, OUTPUTS = 8, 512
STEM = 64
STAGES = ((64, 3, 1), (128, 4, 2), (256, 6, 2), (512, 3, 2))
"""Channels within, repeats, stride of the first."""
WIDENED = 4
"""A bottleneck gives this many times its channels within."""


class Bottleneck(nn.Module):
    """Narrow, filter, widen; added to its input, which is projected where the shapes differ."""

    def __init__(self, channels_in: int, within: int, stride: int) -> None:
        super().__init__()
        out = WIDENED * within
        self.main = nn.Sequential(
            *conv_norm(channels_in, within, 1),
            nn.ReLU(),
            *conv_norm(within, within, 3, stride),
            nn.ReLU(),
            *conv_norm(within, out, 1),
        )
        same = stride == 1 and channels_in == out
        self.shortcut = nn.Identity() if same else nn.Sequential(*conv_norm(channels_in, out, 1, stride))

    def forward(self, x: Tensor) -> Tensor:
        """(n, in, h, w) to (n, 4 within, h / stride, w / stride)."""
        return torch.relu(self.main(x) + self.shortcut(x))


def _features(channels: int) -> nn.Sequential:
    layers: list[nn.Module] = [*conv_norm(channels, STEM, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, padding=1)]
    channels = STEM
    for within, repeats, stride in STAGES:
        for repeat in range(repeats):
            layers.append(Bottleneck(channels, within, stride if repeat == 0 else 1))
            channels = WIDENED * within
    return nn.Sequential(*layers)


class ResNet50(nn.Module):
    """Stacked maps (n, channels, 100, 100) to latents (n, outputs)."""

    def __init__(self, channels: int = INPUT_CHANNELS, outputs: int = OUTPUTS, dropout: float = 0.0) -> None:
        super().__init__()
        self.features = _features(channels)
        self.classifier = nn.Sequential(nn.Dropout(dropout), nn.Linear(WIDENED * STAGES[-1][0], outputs))

    def forward(self, stacked: Tensor) -> Tensor:
        """(n, channels, 100, 100) to (n, outputs)."""
        return self.classifier(self.features(stacked).mean((2, 3)))
