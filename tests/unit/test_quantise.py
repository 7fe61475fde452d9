"""An 8-bit network is smaller, still takes any batch, and answers nearly what the exact one does."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from nlos_models.errors import ModelError
from nlos_models.inference import quantise
from onnx import TensorProto, helper, numpy_helper


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Depth plus intensity, convolved; with a stale shape of the kind that exporters leave."""
    kernel = np.random.default_rng(0).normal(size=(8, 1, 3, 3)).astype(np.float32)
    mix = np.random.default_rng(1).normal(size=(1, 8, 1, 1)).astype(np.float32)
    shape = ["n", 64, 80]
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("depth_m", "intensity")]
    nodes = [
        helper.make_node("Add", ["depth_m", "intensity"], ["sum"]),
        helper.make_node("Unsqueeze", ["sum", "axes"], ["image"]),
        helper.make_node("Conv", ["image", "kernel"], ["wide"], pads=[1, 1, 1, 1]),
        helper.make_node("Conv", ["wide", "mix"], ["answer"]),
    ]
    constants = {"kernel": kernel, "mix": mix, "axes": np.array([1])}
    graph = helper.make_graph(
        nodes,
        "small",
        inputs,
        [helper.make_tensor_value_info("answer", TensorProto.FLOAT, ["n", 1, 64, 80])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
        value_info=[helper.make_tensor_value_info("wide", TensorProto.FLOAT, ["n", 3, 64, 80])],
    )
    path = tmp_path_factory.mktemp("model") / "exact.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return path


def _samples(seed: int, count: int = 4) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(seed)
    return [tuple(generator.random((1, 64, 80), np.float32) for _ in range(2)) for _ in range(count)]  # type: ignore[misc]


def _answer(path: Path, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return session.run(None, {"depth_m": depth_m, "intensity": intensity})[0]


@pytest.mark.parametrize("static", [False, True])
def test_an_8_bit_network_answers_nearly_the_same_for_any_batch(tmp_path: Path, model: Path, static: bool) -> None:
    small = tmp_path / "small.onnx"
    quantise(model, small, _samples(0) if static else None)
    weights = {tensor.name: tensor.data_type for tensor in onnx.load(small).graph.initializer}
    assert {TensorProto.INT8, TensorProto.UINT8} & set(weights.values())
    both = [np.concatenate(maps) for maps in zip(*_samples(1), strict=True)]
    exact, nearly = (_answer(path, *both) for path in (model, small))
    assert nearly.shape == exact.shape == (4, 1, 64, 80)
    assert 0 < np.abs(nearly - exact).mean() < 0.05 * exact.std()
    assert [path.name for path in tmp_path.iterdir()] == ["small.onnx"]


def test_what_cannot_be_quantised_is_told_and_leaves_nothing(tmp_path: Path, model: Path) -> None:
    with pytest.raises(ModelError, match="cannot be made 8-bit"):
        quantise(model, tmp_path / "small.onnx", [])
    assert not list(tmp_path.iterdir())


def test_what_ends_the_writing_leaves_nothing(tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from onnxruntime import quantization

    def interrupted(_: object, path: Path, **__: object) -> None:
        path.write_bytes(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(quantization, "quantize_dynamic", interrupted)
    with pytest.raises(KeyboardInterrupt):
        quantise(model, tmp_path / "small.onnx")
    assert not list(tmp_path.iterdir())
