"""Compressor and decoder as one network: lidar maps in, image of what is hidden out."""

import torch
from torch import Tensor, nn

from nlos_models.compressor import Compressor
from nlos_models.preprocess import Preprocess
from nlos_models.res_vae import Decoder
from nlos_models.silhouette import cut_silhouette, lift_edges


class Pipeline(nn.Module):
    """Maps (n, 64, 80) to images (n, 64, 64) in [0, 1]: preprocessing, compressor, decoder, silhouette."""

    def __init__(self, compressor: Compressor, decoder: Decoder, left_noise: float = 0.2) -> None:
        super().__init__()
        self.preprocess = Preprocess(left_noise)
        self.compressor = compressor
        self.decoder = decoder

    def latent(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Maps (n, 64, 80), NaN depth where there is no return, to latents (n, 256)."""
        return self.compressor(self.preprocess(depth_m, intensity))

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Maps (n, 64, 80) to images (n, 64, 64)."""
        image = self.decoder(self.latent(depth_m, intensity))
        return torch.where(cut_silhouette(image) > 0, lift_edges(image), 0.0)[:, 0]
