"""Inference: ONNX Runtime held equal to torch, exported once, and strict about weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_models import inference
from nlos_models.checkpoint import CheckpointRecord, save_pipeline
from nlos_models.compressor import Compressor
from nlos_models.errors import CheckpointError, ModelError
from nlos_models.inference import OnnxReconstructor, Reconstructor, TorchReconstructor, load_reconstructor
from nlos_models.metrics import LEAST_V
from nlos_models.pipeline import Pipeline, split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.vae import Decoder

RECORD = CheckpointRecord(
    rig_name="paper-rig",
    rig_checksum="0123456789ab",
    vae_recipe=Recipe(task="vae", objects=10, held_out=1, epochs=1, batch=2, learning_rate=1e-3),
)
HANDFUL = 8
"""Pixels of an image that may fall to the other side of the silhouette's threshold."""


def _maps(n: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(n)
    depth = generator.uniform(0.2, 0.8, (n, 64, 80)).astype(np.float32)
    depth[generator.random(depth.shape) < 0.1] = np.nan
    return depth, generator.uniform(0, 255, (n, 64, 80)).astype(np.float32)


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    torch.manual_seed(0)
    made = Pipeline(Compressor(), Decoder())
    made.preprocess.learn(split_and_stack(*(torch.from_numpy(m) for m in _maps(8))))
    with torch.no_grad():
        made.train()(*(torch.from_numpy(m) for m in _maps(8)))  # statistics that are not those of a new network
        features = made.eval().decoder.blocks(made.latent(*(torch.from_numpy(m) for m in _maps(8)))[:, :, None, None])
        logits, output = made.decoder.output(features), made.decoder.output
        output.bias.copy_(2 * (output.bias - logits.mean()) / logits.std())  # an image with contrast: it has edges
        output.weight.mul_(2 / logits.std())
    return made


@pytest.fixture(scope="module")
def folders(pipeline: Pipeline, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    weights, cache = tmp_path_factory.mktemp("weights"), tmp_path_factory.mktemp("cache")
    save_pipeline(weights, pipeline, RECORD)
    return weights, cache


@pytest.fixture(scope="module")
def pair(folders: tuple[Path, Path]) -> tuple[Reconstructor, Reconstructor]:
    """The exported pipeline, and the same weights in torch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        exported = load_reconstructor(*folders)
    return exported, TorchReconstructor(*inference.load_pipeline(folders[0]), "cpu")


def test_a_cpu_gets_onnx_runtime_and_the_record(pair: tuple[Reconstructor, Reconstructor]) -> None:
    assert isinstance(pair[0], OnnxReconstructor)
    assert pair[0].record == pair[1].record == RECORD
    assert pair[0].runtime != pair[1].runtime


@pytest.mark.parametrize("batch", [1, 5])
def test_onnx_equals_torch(pair: tuple[Reconstructor, Reconstructor], batch: int) -> None:
    maps = _maps(batch)
    mine, its = (reconstructor(*maps) for reconstructor in pair)
    assert mine.shape == its.shape == (batch, 64, 64)
    assert mine.dtype == its.dtype == np.float32
    both = (mine > 0) & (its > 0)
    assert ((mine > 0) != (its > 0)).sum((1, 2)).max() <= HANDFUL
    assert 0 < both.mean() < 1
    np.testing.assert_allclose(mine[both], its[both], atol=1e-4)


@pytest.mark.parametrize("name", ["constant", "all zero", "saturated", "half invalid", "all invalid"])
def test_hard_maps_give_a_possible_image_in_either(pair: tuple[Reconstructor, Reconstructor], name: str) -> None:
    depth, intensity = np.full((1, 64, 80), 0.3, np.float32), np.full((1, 64, 80), 10, np.float32)
    if name == "all zero":
        depth[:], intensity[:] = 0, 0
    if name == "saturated":
        intensity[:] = 255
    if "invalid" in name:
        depth[:, :, : 40 if name == "half invalid" else 80] = np.nan
    for reconstructor in pair:
        image = reconstructor(depth, intensity)
        assert ((image == 0) | ((image >= LEAST_V) & (image <= 1))).all()


def test_maps_that_are_not_contiguous_give_the_same(pair: tuple[Reconstructor, Reconstructor]) -> None:
    depth, intensity = _maps(2)
    for reconstructor in pair:
        strided = reconstructor(np.asfortranarray(depth), np.asfortranarray(intensity))
        np.testing.assert_allclose(strided, reconstructor(depth, intensity), atol=1e-6)


def test_a_second_load_exports_nothing(
    folders: tuple[Path, Path], pair: tuple[Reconstructor, Reconstructor], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(pipeline: Pipeline, path: Path) -> None:
        raise AssertionError(f"{path} was exported again for {type(pipeline)}")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(inference, "export_onnx", refuse)
    again, maps = load_reconstructor(*folders), _maps(1)
    np.testing.assert_array_equal(again(*maps), pair[0](*maps))
    assert [path.suffix for path in folders[1].iterdir()] == [".onnx"]


def test_what_ends_an_export_leaves_nothing(
    tmp_path: Path, pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Program:
        def save(self, path: Path, **_: object) -> None:
            path.write_bytes(b"half of it")
            raise KeyboardInterrupt

    monkeypatch.setattr(torch.onnx, "export", lambda *_, **__: Program())
    with pytest.raises(KeyboardInterrupt):
        inference.export_onnx(pipeline, tmp_path / "network.onnx")
    assert not list(tmp_path.iterdir())


def test_networks_of_full_colour_are_not_exported(pipeline: Pipeline, tmp_path: Path) -> None:
    colour = Pipeline(pipeline.compressor, Decoder(3, 512), intensities=3)
    with pytest.raises(ModelError, match=r"full colour \(simulation only.* are not exported"):
        inference.exported(colour, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_exports_name_changes_with_the_weights(pipeline: Pipeline) -> None:
    before = inference.checksum_of(pipeline)
    assert inference.checksum_of(pipeline) == before
    other = Pipeline(pipeline.compressor, Decoder())
    assert inference.checksum_of(other) != before


def test_weights_that_are_not_there_are_a_checkpoint_error(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        load_reconstructor(tmp_path / "none", tmp_path)
