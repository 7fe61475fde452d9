"""The compressor: Table S2 to the parameter."""

import pytest
import torch
from nlos_models.compressor import Compressor, InvertedResidual
from torch import nn


@pytest.fixture(scope="module")
def compressor() -> Compressor:
    torch.manual_seed(0)
    return Compressor().eval()


def test_it_has_exactly_the_papers_parameters(compressor: Compressor) -> None:
    assert sum(p.numel() for p in compressor.parameters() if p.requires_grad) == 2_552_096


def test_the_inverted_residuals_are_table_s2(compressor: Compressor) -> None:
    expected = []
    for _, out, repeats, stride in (
        (1, 16, 1, 1),
        (6, 24, 2, 2),
        (6, 32, 3, 2),
        (6, 64, 4, 2),
        (6, 96, 3, 1),
        (6, 160, 3, 2),
        (6, 320, 1, 1),
    ):
        expected += [(out, stride), *[(out, 1)] * (repeats - 1)]
    found = []
    for block in (m for m in compressor.features if isinstance(m, InvertedResidual)):
        convolutions = [m for m in block.modules() if isinstance(m, nn.Conv2d)]
        found.append((convolutions[-1].out_channels, max(c.stride[0] for c in convolutions)))
    assert found == expected


@pytest.mark.parametrize("width", [0.35, 0.5, 1.4])
def test_a_narrower_one_has_fewer_channels_by_eights_and_the_same_latent(width: float) -> None:
    compressor = Compressor(width=width).eval()
    blocks = [m for m in compressor.features if isinstance(m, InvertedResidual)]
    out = [[c for c in block.modules() if isinstance(c, nn.Conv2d)][-1].out_channels for block in blocks]
    full = [16, *[24] * 2, *[32] * 3, *[64] * 4, *[96] * 3, *[160] * 3, 320]
    assert all(mine % 8 == 0 and abs(mine - width * its) <= 8 for mine, its in zip(out, full, strict=True))
    with torch.inference_mode():
        assert compressor(torch.randn(1, 4, 100, 100)).shape == (1, 256)


def test_it_is_added_to_its_input_only_where_the_shapes_agree() -> None:
    assert InvertedResidual(16, 16, 1, 6).residual
    assert not InvertedResidual(16, 24, 1, 6).residual
    assert not InvertedResidual(16, 16, 2, 6).residual


@torch.inference_mode()
@pytest.mark.parametrize("batch", [1, 3])
def test_stacked_maps_become_latents(compressor: Compressor, batch: int) -> None:
    assert compressor(torch.randn(batch, 4, 100, 100)).shape == (batch, 256)


@torch.inference_mode()
@pytest.mark.parametrize("value", [0.0, 1.0, 1e4, -1e4])
def test_constant_maps_give_finite_latents(compressor: Compressor, value: float) -> None:
    assert torch.isfinite(compressor(torch.full((1, 4, 100, 100), value))).all()


def test_a_batch_of_one_trains() -> None:
    compressor = Compressor().train()
    compressor(torch.randn(1, 4, 100, 100)).square().sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in compressor.parameters())


def test_dropout_acts_only_while_training() -> None:
    torch.manual_seed(0)
    compressor, stacked = Compressor(dropout=0.5), torch.randn(1, 4, 100, 100)
    compressor.features.eval()
    with torch.inference_mode():
        assert not torch.equal(compressor(stacked), compressor(stacked))
        compressor.eval()
        assert torch.equal(compressor(stacked), compressor(stacked))
