"""Reconstruction network from lidar maps to hidden images: preprocessing, compressor, decoder,
silhouette (SI 3, 4).

Split-and-stack cuts maps (64, 80) into four channels: left depth, right depth, left intensity,
right intensity. Columns 0 to 39 are left, nearer the lidar. In color, which is simulation only,
three intensities follow the depth: 8 channels. A color image (n, 3, 64, 64) holds the hidden
object's albedo in red, green and blue: 0 for background, else from 0.1 (black) to 1 (white) in each
channel.

Silhouette: a network trained on squared error answers with the mean of all images that are
possible, so that a pixel near the outline has a fraction of the surface's v. The convention v <
0.05 would count nearly all of them as surface, much too far away. So a pixel is kept only if it
reaches KEPT_SHARE of the brightest pixel around it, and is then lifted to the surface's own v.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from nlos_models.compressor import COLOR_OUTPUTS, DROPOUT, Compressor, ResNet50
from nlos_models.metrics import MIN_V
from nlos_models.vae import Decoder, ResVae

RESIZED = 100
SMALLEST_SPREAD = 1e-6
"""Divisor of a channel without variation."""


def stacked_channels(intensities: int = 1) -> int:
    """Return the number of channels: left and right half of the depth and of each intensity."""
    return 2 * (1 + intensities)


def split_and_stack(depth_m: Tensor, intensity: Tensor) -> Tensor:
    """Stack depth (n, 64, 80) and intensity (n, 64, 80) or (n, k, 64, 80) to (n, 2 + 2 k, 64, 40):
    left, right in turn.

    A cell without a return (NaN depth) is NaN in all of its channels.
    """
    depth = depth_m[:, None]
    each = intensity[:, None] if intensity.ndim == depth_m.ndim else intensity
    # SI 4: the left and the right half of the wall have different distances to the object, and go
    # in as channels of one place, so that one filter compares them.
    maps = torch.cat([depth, torch.where(torch.isnan(depth), depth, each)], dim=1)
    half = depth_m.shape[-1] // 2
    return torch.stack([maps[..., :half], maps[..., half:]], dim=2).flatten(1, 2)


def channel_statistics(stacked: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (channels,) of stacked maps (n, channels, 64, 40) over
    valid cells.
    """
    # In double precision: sums over 10,000 maps of 2,560 cells lose digits in float32, and other
    # batches would then give other statistics.
    values = stacked.transpose(0, 1).flatten(1).double()
    valid = ~torch.isnan(values)
    count = valid.sum(1).clamp(min=1)
    mean = torch.where(valid, values, 0.0).sum(1) / count
    spread = torch.where(valid, values - mean[:, None], 0.0).square().sum(1) / count
    return mean.float(), spread.sqrt().float()


class Preprocess(nn.Module):
    """Preprocessing: normalise each channel, add SI 4's noise to the left ones in training, resize
    to 100 x 100.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, left_noise: float = 0.2, intensities: int = 1) -> None:
        super().__init__()
        self.left_noise = left_noise
        self.register_buffer("mean", torch.zeros(stacked_channels(intensities)))
        self.register_buffer("spread", torch.ones(stacked_channels(intensities)))

    def learn(self, stacked: Tensor, channels: slice = slice(None)) -> None:
        """Set the statistics of all or some channels to those of stacked maps (n, channels, 64,
        40).
        """
        mean, spread = channel_statistics(stacked)
        self.mean[channels] = mean[channels]
        self.spread[channels] = spread[channels]

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Map maps (n, 64, 80) to (n, channels, 100, 100); invalid cells get the channel's mean (0,
        normalised).
        """
        stacked = split_and_stack(depth_m, intensity)
        # Depth is in metres and intensity in counts: without a common scale, the larger one would
        # drive the first layer's gradients.
        scale = self.spread.clamp(min=SMALLEST_SPREAD)
        normal = (stacked - self.mean[:, None, None]) / scale[:, None, None]
        # A missing cell becomes the mean: the value that tells the network least.
        normal = torch.where(torch.isnan(normal), torch.zeros_like(normal), normal)
        if self.training:
            # SI 4: noise of 0.2 spreads on the left half alone, drawn anew at each step, so that
            # the compressor cannot learn single maps by heart.
            for channel in range(0, normal.shape[1], 2):
                normal[:, channel] += self.left_noise * torch.randn_like(normal[:, channel])
        return functional.interpolate(
            normal, (RESIZED, RESIZED), mode="bilinear", align_corners=False
        )


WINDOW = 13
"""Pixels; about 5 cm in the paper's box."""
LIFT_WINDOW = 7
"""Pixels; about as wide as silhouettes are blurred."""
KEPT_SHARE = 0.4


def cut_silhouette(image: Tensor) -> Tensor:
    """Set the background of decoded images (n, channels, h, w) to 0, judging each pixel by its
    brightest channel.
    """
    # Relative to the surroundings, not absolute: a far surface is as dark as the blurred rim of a
    # near one, so that no fixed threshold separates both from the background.
    bright = image.amax(1, keepdim=True)
    brightest = functional.max_pool2d(bright, WINDOW, stride=1, padding=WINDOW // 2)
    kept = (bright >= KEPT_SHARE * brightest) & (bright >= MIN_V)
    return torch.where(kept, image, torch.zeros_like(image))


def lift_edges(image: Tensor) -> Tensor:
    """Raise decoded images (n, 1, h, w) to the smoothed maximum around each pixel; no pixel gets
    darker.
    """
    # A decoder trained with squared error answers p v at an uncertain outline
    # (`losses.image_error`), which reads as a larger distance. The surface's own v is beside it;
    # the mean of the largest values around keeps noise from being lifted too.
    pad = LIFT_WINDOW // 2
    brightest = functional.max_pool2d(image, LIFT_WINDOW, stride=1, padding=pad)
    return torch.maximum(
        image, functional.avg_pool2d(brightest, LIFT_WINDOW, 1, pad, count_include_pad=False)
    )


class RemappingNetwork(nn.Module):
    """Network from maps (n, 64, 80) to images (n, 64, 64) in [0, 1]: preprocessing, compressor,
    decoder, silhouette.

    In color (simulation only: the L515's laser is infrared) intensities are (n, 3, 64, 80), images
    (n, 3, 64, 64).
    """

    def __init__(
        self, compressor: nn.Module, decoder: Decoder, left_noise: float = 0.2, intensities: int = 1
    ) -> None:
        super().__init__()
        self.intensities = intensities
        self.preprocess = Preprocess(left_noise, intensities)
        self.compressor = compressor
        self.decoder = decoder

    def latent(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Return the latents (n, latent) of maps (n, 64, 80) with NaN depth where there is no
        return.
        """
        return self.compressor(self.preprocess(depth_m, intensity))

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Return the images of maps; edges of depth are lifted, edges of color are not: colors
        would mix.
        """
        image = self.decoder(self.latent(depth_m, intensity))
        # First the silhouette, then its depth: lifted edges would otherwise widen the object.
        cut = cut_silhouette(image)
        if image.shape[1] > 1:
            return cut
        return torch.where(cut > 0, lift_edges(image), 0.0)[:, 0]


CHANNELS = 3


def new_vae(*, color: bool) -> ResVae:
    """Return an untrained Res-VAE for 64 x 64 images with a latent of 256, or for 64 x 64 x 3 with
    512 (SI 3).
    """
    return ResVae(CHANNELS, COLOR_OUTPUTS) if color else ResVae()


def new_pipeline(
    decoder: Decoder | None = None,
    *,
    color: bool,
    dropout: float = DROPOUT,
    left_noise: float = 0.2,
    width: float = 1.0,
) -> RemappingNetwork:
    """Return an untrained compressor (MobileNetV2, for color ResNet50; SI 4) before a decoder
    (default: untrained).
    """
    if not color:
        return RemappingNetwork(Compressor(dropout, width), decoder or Decoder(), left_noise)
    return RemappingNetwork(
        ResNet50(dropout=dropout), decoder or Decoder(CHANNELS, COLOR_OUTPUTS), left_noise, CHANNELS
    )
