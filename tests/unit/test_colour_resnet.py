"""ResNet50 to the parameter, and what it does with maps at the ends of their range."""

import pytest
import torch
from nlos_models.compressor import Bottleneck, ResNet50
from torch import nn

PUBLISHED = 25_557_032
"""With 3 inputs and 1000 classes, as everyone counts it."""


def _count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


@pytest.mark.parametrize(
    ("channels", "outputs", "parameters"), [(3, 1000, PUBLISHED), (3, 512, 24_557_120), (8, 512, 24_572_800)]
)
def test_it_has_exactly_the_published_parameters(channels: int, outputs: int, parameters: int) -> None:
    with torch.device("meta"):
        assert _count(ResNet50(channels, outputs)) == parameters


def test_the_bottlenecks_are_three_four_six_and_three() -> None:
    with torch.device("meta"):
        blocks = [m for m in ResNet50().features if isinstance(m, Bottleneck)]
    convolutions = [[m for m in block.main if isinstance(m, nn.Conv2d)] for block in blocks]
    assert [(c[0].out_channels, c[2].out_channels) for c in convolutions] == [
        *[(64, 256)] * 3,
        *[(128, 512)] * 4,
        *[(256, 1024)] * 6,
        *[(512, 2048)] * 3,
    ]
    assert [tuple(c.kernel_size[0] for c in each) for each in convolutions] == [(1, 3, 1)] * 16
    halved = [k for k, each in enumerate(convolutions) if each[1].stride == (2, 2)]
    assert halved == [3, 7, 13]


def test_a_shortcut_is_projected_only_where_the_shapes_differ() -> None:
    assert isinstance(Bottleneck(256, 64, 1).shortcut, nn.Identity)
    assert not isinstance(Bottleneck(64, 64, 1).shortcut, nn.Identity)
    assert not isinstance(Bottleneck(256, 64, 2).shortcut, nn.Identity)


@torch.no_grad()
def test_a_bottleneck_that_adds_nothing_hands_its_input_on() -> None:
    block = Bottleneck(256, 64, 1).eval()
    nn.init.zeros_(block.main[-1].weight)
    x = torch.rand(2, 256, 5, 5)
    assert torch.equal(block(x), x)


def test_dropout_is_before_the_last_layer_alone() -> None:
    with torch.device("meta"):
        net = ResNet50(dropout=0.3)
    assert [m.p for m in net.modules() if isinstance(m, nn.Dropout)] == [0.3]
    assert isinstance(net.classifier[-1], nn.Linear)
