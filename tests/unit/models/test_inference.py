"""Inference: ONNX Runtime held equal to torch, exports that are cached, and 8-bit networks."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from nlos_models import inference
from nlos_models.checkpoint import CheckpointRecord, save_pipeline
from nlos_models.compressor import Compressor
from nlos_models.errors import ModelError
from nlos_models.inference import OnnxReconstructor, Reconstructor, TorchReconstructor, load_reconstructor, quantize
from nlos_models.metrics import MIN_V
from nlos_models.pipeline import RemappingNetwork, split_and_stack
from nlos_models.vae import Decoder
from onnx import TensorProto, helper, numpy_helper
from small_maps import HARD_MAPS, hard_maps
from small_run import small_recipe

pytestmark = pytest.mark.usefixtures("one_thread")

RECORD = CheckpointRecord.of([small_recipe()], ("paper-rig", "0123456789ab"))
HANDFUL = 8
"""Pixels of an image that may fall to the other side of the silhouette's threshold."""
Pair = tuple[Reconstructor, Reconstructor]


def _maps(n: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(n)
    depth = generator.uniform(0.2, 0.8, (n, 64, 80)).astype(np.float32)
    depth[generator.random(depth.shape) < 0.1] = np.nan
    return depth, generator.uniform(0, 255, (n, 64, 80)).astype(np.float32)


@pytest.fixture(scope="module")
def pipeline() -> RemappingNetwork:
    torch.manual_seed(0)
    made, maps = RemappingNetwork(Compressor(), Decoder()), [torch.from_numpy(m) for m in _maps(8)]
    made.preprocess.learn(split_and_stack(*maps))
    with torch.no_grad():
        made.train()(*maps)  # statistics that are not those of a new network
        features = made.eval().decoder.blocks(made.latent(*maps)[:, :, None, None])
        logits, output = made.decoder.output(features), made.decoder.output
        output.bias.copy_(2 * (output.bias - logits.mean()) / logits.std())  # an image with contrast: it has edges
        output.weight.mul_(2 / logits.std())
    return made


@pytest.fixture(scope="module")
def folders(pipeline: RemappingNetwork, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    weights, cache = tmp_path_factory.mktemp("weights"), tmp_path_factory.mktemp("cache")
    save_pipeline(weights, pipeline, RECORD)
    return weights, cache


@pytest.fixture(scope="module")
def pair(folders: tuple[Path, Path]) -> Pair:
    """The exported pipeline, and the same weights in torch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        exported = load_reconstructor(*folders)
    return exported, TorchReconstructor(*inference.load_pipeline(folders[0]), "cpu")


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 5])
def test_onnx_reconstruction_equals_torch(pair: Pair, batch: int) -> None:
    assert isinstance(pair[0], OnnxReconstructor)
    assert pair[0].record == pair[1].record == RECORD
    assert pair[0].runtime != pair[1].runtime
    maps = _maps(batch)
    mine, its = (reconstructor(*maps) for reconstructor in pair)
    for image, reconstructor in zip((mine, its), pair, strict=True):
        strided = reconstructor(*(np.asfortranarray(part) for part in maps))
        np.testing.assert_allclose(strided, image, atol=1e-6)
    assert mine.shape == its.shape == (batch, 64, 64)
    assert mine.dtype == its.dtype == np.float32
    both = (mine > 0) & (its > 0)
    assert ((mine > 0) != (its > 0)).sum((1, 2)).max() <= HANDFUL
    assert 0 < both.mean() < 1
    np.testing.assert_allclose(mine[both], its[both], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD_MAPS)
def test_reconstruction_of_hard_maps_is_a_possible_image(pair: Pair, name: str) -> None:
    for reconstructor in pair:
        image = reconstructor(*(part.numpy() for part in hard_maps(name)))
        assert ((image == 0) | ((image >= MIN_V) & (image <= 1))).all()


@pytest.mark.slow
def test_second_load_exports_nothing(folders: tuple[Path, Path], pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(inference, "export_onnx", lambda _, path: pytest.fail(f"{path} was exported again"))
    again, maps = load_reconstructor(*folders), _maps(1)
    np.testing.assert_array_equal(again(*maps), pair[0](*maps))
    assert [path.suffix for path in folders[1].iterdir()] == [".onnx"]


def _interrupted(path: Path) -> None:
    path.write_bytes(b"half of it")
    raise KeyboardInterrupt


def test_interrupted_export_leaves_no_file(
    tmp_path: Path, pipeline: RemappingNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Program:
        def save(self, path: Path, **_: object) -> None:
            _interrupted(path)

    monkeypatch.setattr(torch.onnx, "export", lambda *_, **__: Program())
    with pytest.raises(KeyboardInterrupt):
        inference.export_onnx(pipeline, tmp_path / "network.onnx")
    assert not list(tmp_path.iterdir())


def test_color_networks_are_not_exported(pipeline: RemappingNetwork, tmp_path: Path) -> None:
    color = RemappingNetwork(pipeline.compressor, Decoder(3, 512), intensities=3)
    with pytest.raises(ModelError, match="simulation only"):
        inference.export_once(color, tmp_path)
    assert not list(tmp_path.iterdir())


def test_export_checksum_depends_on_weights(pipeline: RemappingNetwork) -> None:
    before = inference.checksum_of(pipeline)
    assert inference.checksum_of(pipeline) == before
    assert inference.checksum_of(RemappingNetwork(pipeline.compressor, Decoder())) != before


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of two convolutions, with a stale shape of the kind that exporters leave."""
    kernel = np.random.default_rng(0).normal(size=(8, 1, 3, 3)).astype(np.float32)
    mix = np.random.default_rng(1).normal(size=(1, 8, 1, 1)).astype(np.float32)
    constants = {"kernel": kernel, "mix": mix, "axes": np.array([1])}
    nodes = [
        helper.make_node("Add", ["depth_m", "intensity"], ["sum"]),
        helper.make_node("Unsqueeze", ["sum", "axes"], ["image"]),
        helper.make_node("Conv", ["image", "kernel"], ["wide"], pads=[1, 1, 1, 1]),
        helper.make_node("Conv", ["wide", "mix"], ["answer"]),
    ]

    def value(name: str, *shape: str | int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    graph = helper.make_graph(
        nodes,
        "small",
        [value(name, "n", 64, 80) for name in ("depth_m", "intensity")],
        [value("answer", "n", 1, 64, 80)],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
        value_info=[value("wide", "n", 3, 64, 80)],
    )
    path = tmp_path_factory.mktemp("model") / "exact.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return path


def _samples(seed: int) -> list[tuple[np.ndarray, ...]]:
    generator = np.random.default_rng(seed)
    return [tuple(generator.random((1, 64, 80), np.float32) for _ in range(2)) for _ in range(4)]


def _answer(path: Path, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    return inference.open_session(path).run(None, {"depth_m": depth_m, "intensity": intensity})[0]


@pytest.mark.parametrize("static", [False, True])
def test_quantized_network_is_nearly_exact_for_any_batch(tmp_path: Path, model: Path, static: bool) -> None:
    small = tmp_path / "small.onnx"
    quantize(model, small, _samples(0) if static else None)
    weights = {tensor.name: tensor.data_type for tensor in onnx.load(small).graph.initializer}
    assert {TensorProto.INT8, TensorProto.UINT8} & set(weights.values())
    both = [np.concatenate(maps) for maps in zip(*_samples(1), strict=True)]
    exact, nearly = (_answer(path, *both) for path in (model, small))
    assert nearly.shape == exact.shape == (4, 1, 64, 80)
    assert 0 < np.abs(nearly - exact).mean() < 0.05 * exact.std()
    assert [path.name for path in tmp_path.iterdir()] == ["small.onnx"]


def test_failed_quantisation_leaves_no_file(tmp_path: Path, model: Path) -> None:
    with pytest.raises(ModelError, match="8 bits"):
        quantize(model, tmp_path / "small.onnx", [])
    assert not list(tmp_path.iterdir())
