"""Compressor and decoder as one network: lidar maps in, image of what is hidden out."""

import torch
from torch import Tensor, nn

from nlos_models.preprocess import Preprocess
from nlos_models.res_vae import Decoder
from nlos_models.silhouette import cut_silhouette, lift_edges


class Pipeline(nn.Module):
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
