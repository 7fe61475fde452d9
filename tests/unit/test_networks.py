"""The networks of depth and colour: their sizes, and what those of colour make of hard maps."""

import pytest
import torch
from nlos_models.pipeline import CHANNELS, COLOUR_LATENT, Pipeline, new_pipeline, new_vae, split_and_stack
from small_maps import hard_maps

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    torch.manual_seed(0)
    return new_pipeline(colour=True)


def test_the_colour_vae_is_64_by_64_by_3_with_a_latent_of_512() -> None:
    assert (CHANNELS, COLOUR_LATENT) == (3, 512)
    with torch.device("meta"):
        vae = new_vae(colour=True)
        image, mean, log_variance = vae(torch.empty(2, 3, 64, 64), torch.empty(2, 512))
    assert image.shape == (2, 3, 64, 64)
    assert mean.shape == log_variance.shape == (2, 512)
    counts = [sum(p.numel() for p in part.parameters()) for part in (vae.encoder, vae.decoder)]
    assert counts == [12_715_344, 12_188_083]


@pytest.mark.parametrize(
    ("colour", "channels", "latent", "parameters"), [(False, 4, 256, 2_552_096), (True, 8, 512, 24_572_800)]
)
def test_a_pipeline_is_of_depth_or_of_colour(colour: bool, channels: int, latent: int, parameters: int) -> None:
    with torch.device("meta"):
        vae = new_vae(colour=colour)
        made = new_pipeline(vae.decoder, colour=colour, dropout=0.3, left_noise=0.1)
        own = new_pipeline(colour=colour)
    assert made.decoder is vae.decoder
    assert own.decoder.state_dict().keys() == vae.decoder.state_dict().keys()
    assert vae.latent == latent
    assert made.preprocess.mean.shape == (channels,)
    assert sum(p.numel() for p in made.compressor.parameters()) == parameters
    assert [m.p for m in made.compressor.modules() if isinstance(m, torch.nn.Dropout)] == [0.3]
    assert made.preprocess.left_noise == 0.1


@pytest.mark.parametrize("name", ["constant", "all zero", "saturated", "half invalid", "all invalid"])
def test_hard_maps_give_finite_gradients_and_a_possible_image(pipeline: Pipeline, name: str) -> None:
    maps = hard_maps(name, (CHANNELS,))
    pipeline.preprocess.learn(split_and_stack(*maps))
    pipeline.train().zero_grad()
    pipeline.latent(*maps).square().sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in pipeline.compressor.parameters())
    with torch.inference_mode():
        image = pipeline.eval()(*maps)
    bright = image.amax(1, keepdim=True)
    assert image.shape == (1, CHANNELS, 64, 64)
    assert torch.isfinite(image).all()
    assert (image <= 1).all()
    assert ((bright == 0) | (bright >= 0.1)).all()
