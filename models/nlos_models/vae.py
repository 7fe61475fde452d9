"""Res-VAE between images (n, channels, 64, 64) in [0, 1] and latents (SI 3, Table S1).

Depth images have one channel and a latent of 256, color images three and 512; 512 channels then
enter Table S1. Our choices where the paper is silent: ReLU between convolutions, a sigmoid at the
output, and the encoder as the decoder's mirror (average pooling for upsampling, 1 x 1 convolutions
for mean and log-variance).
"""

import torch
from torch import Tensor, nn

LATENT = 256
UP_BLOCKS = (
    (256, 256, 512),
    (512, 256, 512),
    (512, 128, 256),
    (256, 64, 128),
    (128, 32, 64),
    (64, 16, 32),
)
"""Table S1: input, inner and output channels of each residual block; the first takes the latent's
size as input.
"""
LOG_VARIANCE_LIMIT = 10.0
"""exp() of larger values overflows float16."""


def _conv(channels_in: int, channels_out: int) -> nn.Conv2d:
    return nn.Conv2d(channels_in, channels_out, kernel_size=3, stride=1, padding=1)


def _up_blocks(latent: int) -> list[tuple[int, int, int]]:
    (_, within, out), *rest = UP_BLOCKS
    return [(latent, within, out), *rest]


class ResBlock(nn.Module):
    """Residual block: two convolutions beside a convolved shortcut, then a change of resolution by
    two.
    """

    def __init__(
        self, channels_in: int, within: int, channels_out: int, resample: nn.Module
    ) -> None:
        super().__init__()
        # Table S1 names two convolutions of 3 x 3 and a shortcut with a convolution of its own,
        # since the channels differ in every block.
        self.main = nn.Sequential(
            _conv(channels_in, within),
            nn.BatchNorm2d(within),
            nn.ReLU(),
            _conv(within, channels_out),
            nn.BatchNorm2d(channels_out),
        )
        self.shortcut = _conv(channels_in, channels_out)
        self.resample = resample

    def forward(self, x: Tensor) -> Tensor:
        """Map (n, in, h, w) to (n, out, h', w')."""
        return self.resample(torch.relu(self.main(x) + self.shortcut(x)))


class Decoder(nn.Module):
    """Decoder from latents (n, latent) to images (n, channels, 64, 64) in [0, 1] (Table S1)."""

    def __init__(self, channels: int = 1, latent: int = LATENT) -> None:
        super().__init__()
        # 1 x 1 to 64 x 64 in six blocks, each of which doubles the image at its end: the latent
        # is the image of one pixel that the first block reads.
        up = [
            ResBlock(*block, nn.Upsample(scale_factor=2, mode="nearest"))
            for block in _up_blocks(latent)
        ]
        self.blocks = nn.Sequential(*up)
        self.output = _conv(UP_BLOCKS[-1][-1], channels)

    def forward(self, latent: Tensor) -> Tensor:
        """Map (n, latent) to (n, channels, 64, 64)."""
        # (n, 256) -> (n, 256, 1, 1) -> (n, 16, 64, 64) -> (n, 1, 64, 64)
        return torch.sigmoid(self.output(self.blocks(latent[:, :, None, None])))


class Encoder(nn.Module):
    """Encoder from images (n, channels, 64, 64) to mean and log-variance, each (n, latent)."""

    def __init__(self, channels: int = 1, latent: int = LATENT) -> None:
        super().__init__()
        self.input = _conv(channels, UP_BLOCKS[-1][-1])
        down = [
            # The same blocks backwards. Averaging, not the largest value: v is a depth, and the
            # largest one of a region would favour near pixels.
            ResBlock(out, within, into, nn.AvgPool2d(2))
            for into, within, out in reversed(_up_blocks(latent))
        ]
        self.blocks = nn.Sequential(*down)
        self.mean = nn.Conv2d(latent, latent, 1)
        self.log_variance = nn.Conv2d(latent, latent, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Map (n, channels, 64, 64) to two (n, latent)."""
        features = self.blocks(torch.relu(self.input(image)))
        # The logarithm, since a variance must be positive, and within bounds, since its
        # exponential enters the divergence and the weight of the latent's error.
        log_variance = self.log_variance(features).clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)
        return self.mean(features).flatten(1), log_variance.flatten(1)


class ResVae(nn.Module):
    """Variational autoencoder: encoder, reparametrisation, decoder."""

    def __init__(self, channels: int = 1, latent: int = LATENT) -> None:
        super().__init__()
        self.latent = latent
        self.encoder = Encoder(channels, latent)
        self.decoder = Decoder(channels, latent)

    def forward(self, image: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map images (n, channels, 64, 64) and standard normal noise (n, latent) to image, mean and
        log-variance.
        """
        # Reparametrisation: the noise comes from outside, so that the gradient passes to mean and
        # variance through the draw (Kingma and Welling 2013, 2.4).
        mean, log_variance = self.encoder(image)
        return self.decoder(mean + noise * torch.exp(0.5 * log_variance)), mean, log_variance
