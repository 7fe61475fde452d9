"""Compressors and Res-VAE: published tables, to the parameter, and finite outputs at the ends of
the number range.
"""

import pytest
import torch
from nlos_models import checkpoint, shipped_folder
from nlos_models.compressor import Bottleneck, Compressor, InvertedResidual, ResNet50
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


def _parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def _convolutions(module: nn.Module) -> list[nn.Conv2d]:
    return [m for m in module.modules() if isinstance(m, nn.Conv2d)]


def _channels(module: nn.Module) -> tuple[tuple[int, int], ...]:
    return tuple((c.in_channels, c.out_channels) for c in _convolutions(module))


@pytest.mark.parametrize("width", [0.35, 0.5, 1.0, 1.4])
def test_compressor_has_table_s2_with_channels_scaled_by_width(
    width: float,
) -> None:
    compressor = Compressor(width=width).eval()
    table = ((16, 1, 1), (24, 2, 2), (32, 3, 2), (64, 4, 2), (96, 3, 1), (160, 3, 2), (320, 1, 1))
    expected = [
        (out, stride if k == 0 else 1) for out, repeats, stride in table for k in range(repeats)
    ]
    blocks = [_convolutions(m) for m in compressor.features if isinstance(m, InvertedResidual)]
    for block, (full, stride) in zip(blocks, expected, strict=True):
        out = block[-1].out_channels
        assert max(c.stride[0] for c in block) == stride
        assert out == full if width == 1 else out % 8 == 0 and abs(out - width * full) <= 8

    assert (_parameters(compressor) == 2_552_096) == (width == 1)

    with torch.inference_mode():
        assert compressor(torch.randn(1, 4, 100, 100)).shape == (1, 256)


@torch.no_grad()
def test_blocks_pass_input_on_only_where_shapes_agree() -> None:
    residual = [
        InvertedResidual(16, out, stride, 6).residual for out, stride in ((16, 1), (24, 1), (16, 2))
    ]

    assert residual == [True, False, False]

    shortcuts = [
        Bottleneck(channels, 64, stride).shortcut
        for channels, stride in ((256, 1), (64, 1), (256, 2))
    ]

    assert [isinstance(shortcut, nn.Identity) for shortcut in shortcuts] == [True, False, False]

    block = Bottleneck(256, 64, 1).eval()
    nn.init.zeros_(block.main[-1].weight)
    x = torch.rand(2, 256, 5, 5)

    assert torch.equal(block(x), x)


def test_resnet_has_published_stages_and_one_dropout() -> None:
    with torch.device("meta"):
        net = ResNet50(dropout=0.3)
        assert _parameters(ResNet50(3, 1000)) == 25_557_032  # as published
        assert _parameters(net) == 24_572_800  # 8 channels to a latent of 512
    blocks = [_convolutions(block.main) for block in net.features if type(block) is Bottleneck]
    stages = [*[(64, 256)] * 3, *[(128, 512)] * 4, *[(256, 1024)] * 6, *[(512, 2048)] * 3]

    assert [(c[0].out_channels, c[2].out_channels) for c in blocks] == stages
    assert [tuple(c.kernel_size[0] for c in each) for each in blocks] == [(1, 3, 1)] * 16
    assert [k for k, each in enumerate(blocks) if each[1].stride == (2, 2)] == [3, 7, 13]
    assert [m.p for m in net.modules() if isinstance(m, nn.Dropout)] == [0.3]
    assert isinstance(net.classifier[-1], nn.Linear)


@pytest.fixture(scope="module")
def vae() -> ResVae:
    torch.manual_seed(0)
    return ResVae().eval()


def _norms(block: nn.Module) -> tuple[int, ...]:
    return tuple(n.num_features for n in block.modules() if isinstance(n, nn.BatchNorm2d))


def test_decoder_matches_table_s1_and_encoder_mirrors_it(vae: ResVae) -> None:
    assert tuple(_channels(block) for block in vae.decoder.blocks) == TABLE_S1
    assert [_norms(block) for block in vae.decoder.blocks] == [
        (first[1], second[1]) for first, second, _ in TABLE_S1
    ]
    assert _channels(vae.decoder.output) == ((32, 1),)

    def ends(block: nn.Module) -> tuple[int, int]:
        assert isinstance(block, ResBlock)
        return block.shortcut.in_channels, block.shortcut.out_channels

    down = list(vae.encoder.blocks)
    up = list(vae.decoder.blocks)[::-1]

    assert [ends(block) for block in down] == [ends(block)[::-1] for block in up]
    assert [_norms(block)[0] for block in down] == [_norms(block)[0] for block in up]

    for conv in (conv for block in (*down, *up) for conv in _convolutions(block)):
        assert (conv.kernel_size, conv.stride, conv.padding) == ((3, 3), (1, 1), (1, 1))


def test_color_vae_differs_in_outer_layers_alone() -> None:
    with torch.device("meta"):
        vae = new_vae(color=True)

    assert vae.latent == 512
    assert CHANNELS == 3
    assert COLOR_OUTPUTS == 512

    counts = [sum(p.numel() for p in part.parameters()) for part in (vae.encoder, vae.decoder)]

    assert counts == [12_715_344, 12_188_083]

    blocks = tuple(_channels(block) for block in vae.decoder.blocks)

    assert blocks == (((512, 256), (256, 512), (512, 512)), *TABLE_S1[1:])
    assert _channels(vae.decoder.output) == ((32, 3),)
    assert _channels(vae.encoder.input) == ((3, 32),)
    assert _channels(vae.encoder.mean) == _channels(vae.encoder.log_variance) == ((512, 512),)


@torch.inference_mode()
def test_decoder_is_in_range_and_independent_of_batch(vae: ResVae) -> None:
    far = vae.decoder(torch.tensor([[0.0], [1e4], [-1e4]]).expand(3, LATENT))

    assert ((far >= 0) & (far <= 1)).all()

    latent = torch.randn(3, LATENT)
    alone = torch.cat([vae.decoder(row[None]) for row in latent])

    torch.testing.assert_close(vae.decoder(latent), alone, atol=1e-5, rtol=1e-4)


@torch.inference_mode()
@pytest.mark.parametrize("value", [torch.finfo(torch.float16).max, 1e30, -1e30])
@pytest.mark.parametrize("precision", [torch.float32, torch.float16])
def test_log_variance_is_limited_to_finite_exponentials(
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


@pytest.mark.slow
def test_vae_trains_in_bfloat16() -> None:
    vae = ResVae().train()
    with torch.autocast("cpu", torch.bfloat16):
        image, mean, log_variance = vae(torch.rand(2, 1, 64, 64), torch.randn(2, LATENT))
        loss = image.float().sum() + mean.float().sum() + log_variance.float().sum()
    loss.backward()

    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in vae.parameters())


def test_shipped_weights_load_bit_for_bit_with_record() -> None:
    loaded, record = checkpoint.load_pipeline()
    for part in ("compressor", "preprocess", "decoder"):
        stored = checkpoint.read_tensors(shipped_folder("paper") / f"{part}.safetensors")
        tensors = getattr(loaded, part).state_dict()
        assert tensors.keys() == stored.keys()
        for name, tensor in stored.items():
            assert torch.equal(tensors[name], tensor.to(tensors[name].dtype)), name

    assert record.vae_recipe.augmentation == "mirror"
    assert record.vae_recipe.keep == "last"
    assert record.transfer_recipe is None
