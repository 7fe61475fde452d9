"""The networks of full colour (simulation only: the L515's laser is infrared, 860 nm), as SI 3 and 4 size them.

A colour image (n, 3, 64, 64) holds the hidden object's albedo in red, green and blue: 0 for background, else from 0.1
(black) to 1 (white) in each channel.
"""

from nlos_models.colour_resnet import OUTPUTS as LATENT
from nlos_models.colour_resnet import ResNet50
from nlos_models.pipeline import Pipeline
from nlos_models.res_vae import Decoder, ResVae

CHANNELS = 3


def colour_vae() -> ResVae:
    """A new Res-VAE of 64 x 64 x 3 in and out with a latent of 512 (SI 3)."""
    return ResVae(CHANNELS, LATENT)


def colour_pipeline(decoder: Decoder | None = None, dropout: float = 0.0, left_noise: float = 0.2) -> Pipeline:
    """A new ResNet50 compressor before a decoder of colour images, a new one unless given (SI 4)."""
    compressor = ResNet50(dropout=dropout)
    return Pipeline(compressor, decoder or Decoder(CHANNELS, LATENT), left_noise, CHANNELS)
