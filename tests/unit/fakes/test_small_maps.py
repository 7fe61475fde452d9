"""Stand-ins for networks have the shapes and parts of the real ones, and small maps show the small
images.
"""

from pathlib import Path

import pytest
import small_maps as small
import torch
from nlos_calibration import load_rig
from nlos_models import checkpoint, load_uncertainty_network
from nlos_models.compressor import Compressor
from nlos_models.training import checkpoints
from nlos_models.vae import ResVae
from small_uncertainty import untrained_uncertainty, watched_weights
from torch import nn

pytestmark = pytest.mark.usefixtures("one_thread")


def _shapes(vae: nn.Module, compressor: nn.Module) -> list[torch.Size]:
    rebuilt, mean, log_variance = vae.eval()(torch.rand(2, 1, 64, 64), torch.zeros(2, 256))
    return [
        tensor.shape
        for tensor in (rebuilt, mean, log_variance, compressor.eval()(torch.rand(2, 4, 100, 100)))
    ]


@torch.no_grad()
def test_small_networks_have_shapes_and_parts_of_real_ones() -> None:
    assert _shapes(small.SmallVae(), small.SmallCompressor()) == _shapes(ResVae(), Compressor())

    for compressor in (small.SmallCompressor(0.25, 0.5), Compressor(0.25, 0.5)):
        dropout, linear = compressor.classifier
        assert isinstance(compressor.features, nn.Module)
        assert (dropout.p, linear.out_features) == (0.25, 256)
    for vae in (small.SmallVae(), ResVae()):
        assert any(
            isinstance(part, nn.BatchNorm1d | nn.BatchNorm2d) for part in vae.decoder.modules()
        )
        assert vae.decoder.output.weight.requires_grad


@pytest.mark.parametrize("steps", ["two", "one"])
def test_untrained_weights_load_and_differ_by_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: str
) -> None:
    rig = load_rig("paper-rig")
    watched = watched_weights(tmp_path / "watched")
    for seed in (0, 1):
        untrained_uncertainty(tmp_path / f"doubt{seed}", watched, seed)
        small.untrained_weights(
            tmp_path / str(seed), rig=rig, seed=seed, steps=steps, maps="difference maps"
        )
    small.use_small_networks(monkeypatch, checkpoint)
    (one, record), (other, _) = (checkpoint.load_pipeline(tmp_path / name) for name in "01")

    assert record.rig_checksum == rig.checksum
    assert record.input == "difference maps"
    assert record.compressor_recipe.steps == steps
    assert (checkpoints.load_encoder(tmp_path / "0") is None) == (steps == "one")

    maps = torch.rand(2, 64, 80), torch.rand(2, 64, 80)
    with torch.inference_mode():
        made = [pipeline.latent(*maps) for pipeline in (one, other)]

    assert made[0].shape == (2, 256)
    assert not torch.allclose(*made)

    networks = [load_uncertainty_network(tmp_path / f"doubt{seed}")[0] for seed in (0, 1)]

    assert not torch.equal(*(each.network.pixels.weight for each in networks))


@pytest.mark.parametrize("channels", [(), (3,)])
def test_hard_maps_have_the_named_extremes(channels: tuple[int, ...]) -> None:
    depth, intensity = zip(
        *(small.hard_maps(name, channels) for name in small.HARD_MAPS), strict=True
    )

    assert [float(d.isnan().float().mean()) for d in depth] == [0, 0, 0, 0.5, 1]
    assert [float(i.max()) for i in intensity] == [10, 0, 255, 10, 10]
    assert {i.shape for i in intensity} == {(1, *channels, 64, 80)}
