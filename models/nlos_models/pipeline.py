"""Compressor and decoder as one network: lidar maps in, image of what is hidden out.

Split-and-stack: (64, 80) lidar maps to the (4, 100, 100) that the compressor eats (SI 4).

Channels: left depth, right depth, left intensity, right intensity; left = columns 0 to 39, nearer the lidar. In
colour, which is simulation only, three intensities follow the depth: 8 channels.

Where the surface ends, and how deep it is there: the last step from a decoded image to a hidden depth map.

A network trained on squared error answers with the mean of what could be there: near a silhouette, a fraction of the
surface's v. By the convention v < 0.05 nearly all of that would count as surface, and much too far away. So a pixel is
kept only if it reaches KEPT_SHARE of the brightest about it, and what is kept is lifted to the surface's own v.

The networks that a recipe asks for: of depth, or of full colour (SI 3 and 4), which is simulation only.

A colour image (n, 3, 64, 64) holds the hidden object's albedo in red, green and blue: 0 for background, else from 0.1
(black) to 1 (white) in each channel.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from nlos_models.compressor import COLOR_OUTPUTS as COLOUR_LATENT
from nlos_models.compressor import DROPOUT, Compressor, ResNet50
from nlos_models.metrics import MIN_V
from nlos_models.vae import Decoder, ResVae

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


WINDOW = 13
"""Pixels; about 5 cm in the paper's box."""
LIFT_WINDOW = 7
"""Pixels; about as wide as silhouettes are blurred."""
KEPT_SHARE = 0.4


def cut_silhouette(image: Tensor) -> Tensor:
    """Decoded images (n, channels, h, w) as hidden images: 0 for background; a pixel's brightest channel tells."""
    bright = image.amax(1, keepdim=True)
    brightest = functional.max_pool2d(bright, WINDOW, stride=1, padding=WINDOW // 2)
    kept = (bright >= KEPT_SHARE * brightest) & (bright >= MIN_V)
    return torch.where(kept, image, torch.zeros_like(image))


def lift_edges(image: Tensor) -> Tensor:
    """Raise decoded images (n, 1, h, w) to the smoothed brightest of their surroundings; nothing gets darker."""
    pad = LIFT_WINDOW // 2
    brightest = functional.max_pool2d(image, LIFT_WINDOW, stride=1, padding=pad)
    return torch.maximum(image, functional.avg_pool2d(brightest, LIFT_WINDOW, 1, pad, count_include_pad=False))


class RemappingNetwork(nn.Module):
    """Maps (n, 64, 80) to images (n, 64, 64) in [0, 1]: preprocessing, compressor, decoder, silhouette.

    In colour (simulation only: the L515's laser is infrared) intensities (n, 3, 64, 80) to images (n, 3, 64, 64).
    """

    def __init__(self, compressor: nn.Module, decoder: Decoder, left_noise: float = 0.2, intensities: int = 1) -> None:
        super().__init__()
        self.intensities = intensities
        self.preprocess = Preprocess(left_noise, intensities)
        self.compressor = compressor
        self.decoder = decoder

    def latent(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Maps (n, 64, 80), NaN depth where there is no return, to latents (n, latent)."""
        return self.compressor(self.preprocess(depth_m, intensity))

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Maps to images; depth is lifted to its brightest about an edge, where colours would run into each other."""
        image = self.decoder(self.latent(depth_m, intensity))
        cut = cut_silhouette(image)
        if image.shape[1] > 1:
            return cut
        return torch.where(cut > 0, lift_edges(image), 0.0)[:, 0]


CHANNELS = 3


def new_vae(*, colour: bool) -> ResVae:
    """A new Res-VAE: of 64 x 64 with a latent of 256, or in colour of 64 x 64 x 3 with one of 512 (SI 3)."""
    return ResVae(CHANNELS, COLOUR_LATENT) if colour else ResVae()


def new_pipeline(
    decoder: Decoder | None = None,
    *,
    colour: bool,
    dropout: float = DROPOUT,
    left_noise: float = 0.2,
    width: float = 1.0,
) -> RemappingNetwork:
    """A new compressor before a decoder, a new one unless given: MobileNetV2, or in colour ResNet50 (SI 4)."""
    if not colour:
        return RemappingNetwork(Compressor(dropout, width), decoder or Decoder(), left_noise)
    return RemappingNetwork(
        ResNet50(dropout=dropout), decoder or Decoder(CHANNELS, COLOUR_LATENT), left_noise, CHANNELS
    )
