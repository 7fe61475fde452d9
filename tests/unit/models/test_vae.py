"""Res-VAE: Table S1, its mirror, and finite outputs at the ends of the number range."""

import pytest
import torch
from nlos_models.pipeline import CHANNELS, COLOR_OUTPUTS, new_vae
from nlos_models.vae import LATENT, LOG_VARIANCE_LIMIT, Encoder, ResBlock, ResVae
from torch import nn

pytestmark = pytest.mark.usefixtures("one_thread")

TABLE_S1 = (
    # main path: two convolutions; shortcut
    ((256, 256), (256, 512), (256, 512)),
    ((512, 256), (256, 512), (512, 512)),
    ((512, 128), (128, 256), (512, 256)),
    ((256, 64), (64, 128), (256, 128)),
    ((128, 32), (32, 64), (128, 64)),
    ((64, 16), (16, 32), (64, 32)),
)


@pytest.fixture(scope="module")
def vae() -> ResVae:
    torch.manual_seed(0)
    return ResVae().eval()


def _convolutions(block: nn.Module) -> tuple[tuple[int, int], ...]:
    return tuple((c.in_channels, c.out_channels) for c in block.modules() if isinstance(c, nn.Conv2d))


def _norms(block: nn.Module) -> tuple[int, ...]:
    return tuple(n.num_features for n in block.modules() if isinstance(n, nn.BatchNorm2d))


def test_decoder_matches_table_s1(vae: ResVae) -> None:
    blocks = list(vae.decoder.blocks)
    assert tuple(_convolutions(block) for block in blocks) == TABLE_S1
    assert [_norms(block) for block in blocks] == [(first[1], second[1]) for first, second, _ in TABLE_S1]
    assert _convolutions(vae.decoder.output) == ((32, 1),)


def test_color_vae_differs_in_outer_layers_alone() -> None:
    with torch.device("meta"):
        vae = new_vae(color=True)
    assert (vae.latent, CHANNELS, COLOR_OUTPUTS) == (512, 3, 512)
    counts = [sum(p.numel() for p in part.parameters()) for part in (vae.encoder, vae.decoder)]
    assert counts == [12_715_344, 12_188_083]
    blocks = tuple(_convolutions(block) for block in vae.decoder.blocks)
    assert blocks == (((512, 256), (256, 512), (512, 512)), *TABLE_S1[1:])
    assert _convolutions(vae.decoder.output) == ((32, 3),)
    assert _convolutions(vae.encoder.input) == ((3, 32),)
    assert _convolutions(vae.encoder.mean) == _convolutions(vae.encoder.log_variance) == ((512, 512),)


def test_encoder_mirrors_decoder(vae: ResVae) -> None:
    def ends(block: nn.Module) -> tuple[int, int]:
        assert isinstance(block, ResBlock)
        return block.shortcut.in_channels, block.shortcut.out_channels

    down, up = list(vae.encoder.blocks), list(vae.decoder.blocks)[::-1]
    assert [ends(block) for block in down] == [ends(block)[::-1] for block in up]
    assert [_norms(block)[0] for block in down] == [_norms(block)[0] for block in up]
    for conv in (m for block in (*down, *up) for m in block.modules() if isinstance(m, nn.Conv2d)):
        assert (conv.kernel_size, conv.stride, conv.padding) == ((3, 3), (1, 1), (1, 1))


@torch.inference_mode()
def test_decoder_is_in_range_and_independent_of_batch(vae: ResVae) -> None:
    far = vae.decoder(torch.tensor([[0.0], [1e4], [-1e4]]).expand(3, LATENT))
    assert ((far >= 0) & (far <= 1)).all()
    latent = torch.randn(3, LATENT)
    alone = torch.cat([vae.decoder(row[None]) for row in latent])
    torch.testing.assert_close(vae.decoder(latent), alone, atol=1e-5, rtol=1e-4)


@torch.inference_mode()
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_vae_of_constant_images_is_finite_and_in_range(vae: ResVae, value: float) -> None:
    image, mean, log_variance = vae(torch.full((2, 1, 64, 64), value), torch.ones(2, LATENT))
    assert image.shape == (2, 1, 64, 64)
    assert mean.shape == log_variance.shape == (2, LATENT)
    assert ((image >= 0) & (image <= 1)).all()
    assert torch.isfinite(mean).all()
    assert torch.isfinite(log_variance).all()


@torch.inference_mode()
@pytest.mark.parametrize("value", [torch.finfo(torch.float16).max, 1e30, -1e30])
@pytest.mark.parametrize("precision", [torch.float32, torch.float16])
def test_log_variance_is_limited_to_finite_exponentials(value: float, precision: torch.dtype) -> None:
    encoder = Encoder().eval()
    nn.init.constant_(encoder.log_variance.weight, 0.0)
    nn.init.constant_(encoder.log_variance.bias, value)
    mean, log_variance = encoder(torch.rand(1, 1, 64, 64))
    assert (log_variance.abs() == LOG_VARIANCE_LIMIT).all()
    for sign in (1, -1):
        assert torch.isfinite(torch.exp(sign * log_variance.to(precision))).all()
    assert torch.isfinite(mean).all()


def test_vae_trains_in_bfloat16() -> None:
    vae = ResVae().train()
    with torch.autocast("cpu", torch.bfloat16):
        image, mean, log_variance = vae(torch.rand(2, 1, 64, 64), torch.randn(2, LATENT))
        loss = image.float().sum() + mean.float().sum() + log_variance.float().sum()
    loss.backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in vae.parameters())
