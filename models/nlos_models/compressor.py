"""Compressors from maps to latents (SI 4): MobileNetV2 for depth, ResNet50 for color.

MobileNetV2 has 4 input channels and 256 outputs (Table S2; 2,552,096 parameters). ResNet50 has 8
input channels and 512 outputs (24,572,800 parameters; SI's 24,557,120 is the count for 3 inputs),
with bottlenecks 3-4-6-3 (He et al., "Deep Residual Learning for Image Recognition", 2015, table 1)
and the stride in the 3 x 3 convolution, as is common; the number of parameters is the same.
"""

import torch
from torch import Tensor, nn

INPUT_CHANNELS = 4
STEM = 32
HEAD = 1280
OUTPUTS = 256
STAGES = (
    (1, 16, 1, 1),
    (6, 24, 2, 2),
    (6, 32, 3, 2),
    (6, 64, 4, 2),
    (6, 96, 3, 1),
    (6, 160, 3, 2),
    (6, 320, 1, 1),
)
"""Table S2: expansion, channels, repeats, stride of the first."""
DROPOUT = 0.5


class Filter(nn.Conv2d):
    """Convolution that a CPU runs in float32 where it strides over single channels: bfloat16 is
    slow there.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  nn.Conv2d's name
        """Map (n, in, h, w) to (n, out, h', w')."""
        # Only these are slow in bfloat16 on a CPU; all other layers are faster in it.
        if self.groups == 1 or self.stride[0] == 1 or input.device.type != "cpu":
            return super().forward(input)
        with torch.autocast("cpu", enabled=False):
            return super().forward(input.float())


def conv_norm(
    channels_in: int, channels_out: int, kernel: int, stride: int = 1, groups: int = 1
) -> list[nn.Module]:
    """Return a padded convolution and its batch norm; only the stride changes the image's size."""
    # Half the kernel on each side, so that n becomes n / stride, also for a kernel of 1. No bias:
    # the batch norm after it would subtract it.
    padding = kernel // 2
    conv = Filter(channels_in, channels_out, kernel, stride, padding, groups=groups, bias=False)
    return [conv, nn.BatchNorm2d(channels_out)]


class InvertedResidual(nn.Module):
    """Residual block: expand, filter each channel, project; its input is added where the shapes
    agree.
    """

    def __init__(self, channels_in: int, channels_out: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = channels_in * expansion
        # Sandler et al. 2018: nonlinear where there are many channels, linear where there are
        # few; a ReLU on the narrow side would lose information, so that none follows the
        # projection.
        layers = [*conv_norm(channels_in, hidden, 1), nn.ReLU6()] if expansion > 1 else []
        layers += [*conv_norm(hidden, hidden, 3, stride, groups=hidden), nn.ReLU6()]
        self.layers = nn.Sequential(*layers, *conv_norm(hidden, channels_out, 1))
        self.residual = stride == 1 and channels_in == channels_out

    def forward(self, x: Tensor) -> Tensor:
        """Map (n, in, h, w) to (n, out, h / stride, w / stride)."""
        return x + self.layers(x) if self.residual else self.layers(x)


def _scale_channels(channels: int, width: float) -> int:
    """Return the channels of a layer in a network of this width: a multiple of 8, by MobileNetV2's
    rule.
    """
    # Multiples of 8 fill a CPU's vector registers.
    return max(8, int(channels * width + 4) // 8 * 8)


def _features(width: float) -> nn.Sequential:
    channels = _scale_channels(STEM, width)
    layers: list[nn.Module] = [*conv_norm(INPUT_CHANNELS, channels, 3, stride=2), nn.ReLU6()]
    for expansion, full, repeats, stride in STAGES:
        out = _scale_channels(full, width)
        for repeat in range(repeats):
            # Only the first block of a stage halves the image; the others are residual.
            layers.append(InvertedResidual(channels, out, stride if repeat == 0 else 1, expansion))
            channels = out
    return nn.Sequential(*layers, *conv_norm(channels, HEAD, 1), nn.ReLU6())


class Compressor(nn.Module):
    """MobileNetV2 from stacked maps (n, 4, 100, 100) to latents (n, 256); `width` scales all layers
    but the last.
    """

    def __init__(self, dropout: float = DROPOUT, width: float = 1.0) -> None:
        super().__init__()
        self.features = _features(width)
        self.classifier = nn.Sequential(nn.Dropout(dropout), nn.Linear(HEAD, OUTPUTS))

    def forward(self, stacked: Tensor) -> Tensor:
        """Map (n, 4, 100, 100) to (n, 256)."""
        # Features (n, 1280, 4, 4) are averaged over places: the paper's classifier has no places,
        # and the latent must come from all of the map.
        return self.classifier(self.features(stacked).mean((2, 3)))


COLOR_INPUT_CHANNELS = 8
COLOR_OUTPUTS = 512
COLOR_STEM = 64
COLOR_STAGES = ((64, 3, 1), (128, 4, 2), (256, 6, 2), (512, 3, 2))
"""Inner channels, repeats, stride of the first."""
WIDENED = 4
"""Output channels of a bottleneck per inner channel."""


class Bottleneck(nn.Module):
    """Residual block: narrow, filter, widen; its input is added, projected where the shapes
    differ.
    """

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
        # He et al. 2016: the input is added, so that a block starts as a small change and the
        # gradient reaches the first layers; where shapes differ it is projected.
        same = stride == 1 and channels_in == out
        self.shortcut = (
            nn.Identity() if same else nn.Sequential(*conv_norm(channels_in, out, 1, stride))
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (n, in, h, w) to (n, 4 within, h / stride, w / stride)."""
        return torch.relu(self.main(x) + self.shortcut(x))


def _color_features(channels: int) -> nn.Sequential:
    layers: list[nn.Module] = [
        *conv_norm(channels, COLOR_STEM, 7, 2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2, padding=1),
    ]
    channels = COLOR_STEM
    for within, repeats, stride in COLOR_STAGES:
        for repeat in range(repeats):
            layers.append(Bottleneck(channels, within, stride if repeat == 0 else 1))
            channels = WIDENED * within
    return nn.Sequential(*layers)


class ResNet50(nn.Module):
    """ResNet50 from stacked maps (n, channels, 100, 100) to latents (n, outputs)."""

    def __init__(
        self,
        channels: int = COLOR_INPUT_CHANNELS,
        outputs: int = COLOR_OUTPUTS,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.features = _color_features(channels)
        self.classifier = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(WIDENED * COLOR_STAGES[-1][0], outputs)
        )

    def forward(self, stacked: Tensor) -> Tensor:
        """Map (n, channels, 100, 100) to (n, outputs)."""
        return self.classifier(self.features(stacked).mean((2, 3)))
