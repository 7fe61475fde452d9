"""The compressor: MobileNetV2 with 4 input channels and 256 outputs (SI 4, Table S2; 2,552,096 parameters)."""

from torch import Tensor, nn

INPUT_CHANNELS = 4
STEM, HEAD, OUTPUTS = 32, 1280, 256
STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1))
"""Table S2: expansion, channels, repeats, stride of the first."""
DROPOUT = 0.5


def conv_norm(channels_in: int, channels_out: int, kernel: int, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    """A convolution that keeps the size but for its stride, and its batch norm."""
    padding = kernel // 2
    conv = nn.Conv2d(channels_in, channels_out, kernel, stride, padding, groups=groups, bias=False)
    return [conv, nn.BatchNorm2d(channels_out)]


class InvertedResidual(nn.Module):
    """Expand, filter each channel, project; added to its input where the shapes allow."""

    def __init__(self, channels_in: int, channels_out: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = channels_in * expansion
        layers = [*conv_norm(channels_in, hidden, 1), nn.ReLU6()] if expansion > 1 else []
        layers += [*conv_norm(hidden, hidden, 3, stride, groups=hidden), nn.ReLU6()]
        self.layers = nn.Sequential(*layers, *conv_norm(hidden, channels_out, 1))
        self.residual = stride == 1 and channels_in == channels_out

    def forward(self, x: Tensor) -> Tensor:
        """(n, in, h, w) to (n, out, h / stride, w / stride)."""
        return x + self.layers(x) if self.residual else self.layers(x)


def thinned(channels: int, width: float) -> int:
    """So many of a layer's channels as a network of this width has: MobileNetV2's rule, in eights."""
    return max(8, int(channels * width + 4) // 8 * 8)


def _features(width: float) -> nn.Sequential:
    channels = thinned(STEM, width)
    layers: list[nn.Module] = [*conv_norm(INPUT_CHANNELS, channels, 3, stride=2), nn.ReLU6()]
    for expansion, full, repeats, stride in STAGES:
        out = thinned(full, width)
        for repeat in range(repeats):
            layers.append(InvertedResidual(channels, out, stride if repeat == 0 else 1, expansion))
            channels = out
    return nn.Sequential(*layers, *conv_norm(channels, HEAD, 1), nn.ReLU6())


class Compressor(nn.Module):
    """Split-and-stack maps (n, 4, 100, 100) to latents (n, 256); of another width, all but the last layer is so."""

    def __init__(self, dropout: float = DROPOUT, width: float = 1.0) -> None:
        super().__init__()
        self.features = _features(width)
        self.classifier = nn.Sequential(nn.Dropout(dropout), nn.Linear(HEAD, OUTPUTS))

    def forward(self, stacked: Tensor) -> Tensor:
        """(n, 4, 100, 100) to (n, 256)."""
        return self.classifier(self.features(stacked).mean((2, 3)))
