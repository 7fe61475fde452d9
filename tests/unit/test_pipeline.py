"""Compressor and decoder as one network, on the maps that a bench may well deliver."""

import pytest
import torch
from nlos_models.checkpoint import load_pipeline, shipped_folder
from nlos_models.compressor import Compressor
from nlos_models.metrics import LEAST_V
from nlos_models.pipeline import Pipeline
from nlos_models.vae import Decoder
from safetensors.torch import load_file
from small_maps import hard_maps


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    torch.manual_seed(0)
    return Pipeline(Compressor(), Decoder()).eval()


@torch.inference_mode()
@pytest.mark.parametrize("name", ["constant", "all zero", "saturated", "half invalid", "all invalid"])
@pytest.mark.parametrize("bfloat16", [False, True])
def test_hard_maps_give_a_possible_hidden_image(pipeline: Pipeline, name: str, bfloat16: bool) -> None:
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        image = pipeline(*hard_maps(name))
    assert image.shape == (1, 64, 64)
    assert ((image == 0) | ((image >= LEAST_V) & (image <= 1))).all()


@torch.inference_mode()
def test_a_sample_does_not_depend_on_its_batch(pipeline: Pipeline) -> None:
    depth, intensity = torch.rand(3, 64, 80), 50 * torch.rand(3, 64, 80)
    alone = torch.cat([pipeline.latent(d[None], i[None]) for d, i in zip(depth, intensity, strict=True)])
    torch.testing.assert_close(pipeline.latent(depth, intensity), alone, atol=1e-4, rtol=1e-3)


@torch.inference_mode()
def test_maps_that_are_not_contiguous_give_the_same(pipeline: Pipeline) -> None:
    depth, intensity = torch.rand(1, 80, 64), 50 * torch.rand(1, 80, 64)
    turned = pipeline.latent(depth.transpose(1, 2), intensity.transpose(1, 2))
    copied = pipeline.latent(depth.transpose(1, 2).contiguous(), intensity.transpose(1, 2).contiguous())
    torch.testing.assert_close(turned, copied, atol=1e-5, rtol=1e-4)


def test_the_shipped_weights_are_loaded_bit_for_bit() -> None:
    loaded, _ = load_pipeline()
    for part in ("compressor", "preprocess", "decoder"):
        stored = load_file(shipped_folder() / f"{part}.safetensors")
        tensors = getattr(loaded, part).state_dict()
        assert tensors.keys() == stored.keys()
        for name, tensor in stored.items():
            assert torch.equal(tensors[name], tensor.to(tensors[name].dtype)), name
