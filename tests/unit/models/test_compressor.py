"""The compressor of depth (Table S2) and that of color (ResNet50), to the parameter."""

import pytest
import torch
from nlos_models.compressor import Bottleneck, Compressor, InvertedResidual, ResNet50
from torch import nn

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def compressor() -> Compressor:
    torch.manual_seed(0)
    return Compressor().eval()


def _parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def _convolutions(module: nn.Module) -> list[nn.Conv2d]:
    return [m for m in module.modules() if isinstance(m, nn.Conv2d)]


def test_compressor_matches_table_s2(compressor: Compressor) -> None:
    table = ((16, 1, 1), (24, 2, 2), (32, 3, 2), (64, 4, 2), (96, 3, 1), (160, 3, 2), (320, 1, 1))
    expected = [(out, stride if k == 0 else 1) for out, repeats, stride in table for k in range(repeats)]
    blocks = [_convolutions(m) for m in compressor.features if isinstance(m, InvertedResidual)]
    assert [(block[-1].out_channels, max(c.stride[0] for c in block)) for block in blocks] == expected
    assert _parameters(compressor) == 2_552_096


@pytest.mark.parametrize("width", [0.35, 0.5, 1.4])
def test_compressor_width_scales_channels_in_steps_of_eight(width: float) -> None:
    compressor = Compressor(width=width).eval()
    blocks = [m for m in compressor.features if isinstance(m, InvertedResidual)]
    out = [_convolutions(block)[-1].out_channels for block in blocks]
    full = [16, *[24] * 2, *[32] * 3, *[64] * 4, *[96] * 3, *[160] * 3, 320]
    assert all(mine % 8 == 0 and abs(mine - width * its) <= 8 for mine, its in zip(out, full, strict=True))
    with torch.inference_mode():
        assert compressor(torch.randn(1, 4, 100, 100)).shape == (1, 256)


def test_blocks_pass_input_on_only_where_shapes_agree() -> None:
    residual = [InvertedResidual(16, out, stride, 6).residual for out, stride in ((16, 1), (24, 1), (16, 2))]
    assert residual == [True, False, False]
    shortcuts = [Bottleneck(channels, 64, stride).shortcut for channels, stride in ((256, 1), (64, 1), (256, 2))]
    assert [isinstance(shortcut, nn.Identity) for shortcut in shortcuts] == [True, False, False]


@torch.inference_mode()
@pytest.mark.parametrize("value", [0.0, 1.0, 1e4, -1e4])
def test_compressor_latents_of_constant_maps_are_finite(compressor: Compressor, value: float) -> None:
    latents = compressor(torch.full((3, 4, 100, 100), value))
    assert latents.shape == (3, 256)
    assert torch.isfinite(latents).all()


def test_compressor_trains_on_batch_of_one() -> None:
    compressor = Compressor().train()
    compressor(torch.randn(1, 4, 100, 100)).square().sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in compressor.parameters())


def test_compressor_dropout_acts_only_in_training() -> None:
    torch.manual_seed(0)
    compressor, stacked = Compressor(dropout=0.5), torch.randn(1, 4, 100, 100)
    compressor.features.eval()
    with torch.inference_mode():
        assert not torch.equal(compressor(stacked), compressor(stacked))
        compressor.eval()
        assert torch.equal(compressor(stacked), compressor(stacked))


def test_resnet_has_published_stages_and_one_dropout() -> None:
    with torch.device("meta"):
        net = ResNet50(dropout=0.3)
        assert _parameters(ResNet50(3, 1000)) == 25_557_032  # as published
        assert _parameters(net) == 24_572_800  # 8 channels to a latent of 512
    blocks = [
        [m for m in block.main if isinstance(m, nn.Conv2d)] for block in net.features if type(block) is Bottleneck
    ]
    stages = [*[(64, 256)] * 3, *[(128, 512)] * 4, *[(256, 1024)] * 6, *[(512, 2048)] * 3]
    assert [(c[0].out_channels, c[2].out_channels) for c in blocks] == stages
    assert [tuple(c.kernel_size[0] for c in each) for each in blocks] == [(1, 3, 1)] * 16
    assert [k for k, each in enumerate(blocks) if each[1].stride == (2, 2)] == [3, 7, 13]
    assert [m.p for m in net.modules() if isinstance(m, nn.Dropout)] == [0.3]
    assert isinstance(net.classifier[-1], nn.Linear)


@torch.no_grad()
def test_bottleneck_with_zero_main_path_is_identity() -> None:
    block = Bottleneck(256, 64, 1).eval()
    nn.init.zeros_(block.main[-1].weight)
    x = torch.rand(2, 256, 5, 5)
    assert torch.equal(block(x), x)
