"""Res-VAE: Table S1 and its mirror, and the ends of the number line."""

import pytest
import torch
from nlos_models.vae import LATENT, LOG_VARIANCE_LIMIT, Decoder, Encoder, ResBlock, ResVae
from torch import nn

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


def test_the_decoder_is_table_s1(vae: ResVae) -> None:
    blocks = list(vae.decoder.blocks)
    assert tuple(_convolutions(block) for block in blocks) == TABLE_S1
    assert [_norms(block) for block in blocks] == [(first[1], second[1]) for first, second, _ in TABLE_S1]
    assert _convolutions(vae.decoder.output) == ((32, 1),)


def test_another_latent_enters_the_first_block_and_other_channels_leave_the_last() -> None:
    with torch.device("meta"):
        vae = ResVae(channels=3, latent=512)
    blocks = tuple(_convolutions(block) for block in vae.decoder.blocks)
    assert blocks == (((512, 256), (256, 512), (512, 512)), *TABLE_S1[1:])
    assert _convolutions(vae.decoder.output) == ((32, 3),)
    assert _convolutions(vae.encoder.input) == ((3, 32),)
    assert _convolutions(vae.encoder.mean) == _convolutions(vae.encoder.log_variance) == ((512, 512),)


def test_the_encoder_is_the_decoders_mirror(vae: ResVae) -> None:
    def ends(block: nn.Module) -> tuple[int, int]:
        assert isinstance(block, ResBlock)
        return block.shortcut.in_channels, block.shortcut.out_channels

    down, up = [ends(b) for b in vae.encoder.blocks], [ends(b) for b in vae.decoder.blocks]
    assert down == [(out, into) for into, out in reversed(up)]
    within = [_norms(b)[0] for b in vae.encoder.blocks]
    assert within == [_norms(b)[0] for b in vae.decoder.blocks][::-1]


def test_every_convolution_of_the_blocks_keeps_the_size(vae: ResVae) -> None:
    for block in (*vae.decoder.blocks, *vae.encoder.blocks):
        for conv in (m for m in block.modules() if isinstance(m, nn.Conv2d)):
            assert (conv.kernel_size, conv.stride, conv.padding) == ((3, 3), (1, 1), (1, 1))


@torch.inference_mode()
def test_64_by_64_in_and_out(vae: ResVae) -> None:
    image, mean, log_variance = vae(torch.rand(2, 1, 64, 64), torch.zeros(2, LATENT))
    assert image.shape == (2, 1, 64, 64)
    assert mean.shape == log_variance.shape == (2, LATENT)
    assert ((image >= 0) & (image <= 1)).all()


@torch.inference_mode()
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_constant_images_give_finite_latents_and_images(vae: ResVae, value: float) -> None:
    for part in vae(torch.full((1, 1, 64, 64), value), torch.ones(1, LATENT)):
        assert torch.isfinite(part).all()


@torch.inference_mode()
@pytest.mark.parametrize("value", [torch.finfo(torch.float16).max, 1e30, -1e30])
@pytest.mark.parametrize("precision", [torch.float32, torch.float16])
def test_log_variance_at_the_ends_of_a_type_stays_where_its_exponential_is_finite(
    value: float, precision: torch.dtype
) -> None:
    encoder = Encoder().eval()
    nn.init.constant_(encoder.log_variance.weight, 0.0)
    nn.init.constant_(encoder.log_variance.bias, value)
    mean, log_variance = encoder(torch.rand(1, 1, 64, 64))
    assert (log_variance.abs() == LOG_VARIANCE_LIMIT).all()
    for sign in (1, -1):
        assert torch.isfinite(torch.exp(sign * log_variance.to(precision))).all()
    assert torch.isfinite(mean).all()


@torch.inference_mode()
@pytest.mark.parametrize("scale", [0.0, 1e4, -1e4])
def test_far_latents_decode_to_finite_images(vae: ResVae, scale: float) -> None:
    image = vae.decoder(torch.full((1, LATENT), scale))
    assert ((image >= 0) & (image <= 1)).all()


def test_bfloat16_trains_to_finite_gradients() -> None:
    vae = ResVae().train()
    with torch.autocast("cpu", torch.bfloat16):
        image, mean, log_variance = vae(torch.rand(2, 1, 64, 64), torch.randn(2, LATENT))
        loss = image.float().sum() + mean.float().sum() + log_variance.float().sum()
    loss.backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in vae.parameters())


@torch.inference_mode()
def test_a_sample_does_not_depend_on_its_batch_in_eval() -> None:
    decoder, latent = Decoder().eval(), torch.randn(3, LATENT)
    alone = torch.cat([decoder(row[None]) for row in latent])
    torch.testing.assert_close(decoder(latent), alone, atol=1e-5, rtol=1e-4)
