"""The networks that a recipe asks for: of depth, or of full colour (SI 3 and 4), which is simulation only.

A colour image (n, 3, 64, 64) holds the hidden object's albedo in red, green and blue: 0 for background, else from 0.1
(black) to 1 (white) in each channel.
"""

from nlos_models.colour_resnet import OUTPUTS as COLOUR_LATENT
from nlos_models.colour_resnet import ResNet50
from nlos_models.compressor import DROPOUT, Compressor
from nlos_models.pipeline import Pipeline
from nlos_models.res_vae import Decoder, ResVae

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
) -> Pipeline:
    """A new compressor before a decoder, a new one unless given: MobileNetV2, or in colour ResNet50 (SI 4)."""
    if not colour:
        return Pipeline(Compressor(dropout, width), decoder or Decoder(), left_noise)
    return Pipeline(ResNet50(dropout=dropout), decoder or Decoder(CHANNELS, COLOUR_LATENT), left_noise, CHANNELS)
