"""Export of networks to ONNX with torch: graphs that point into a checkpoint's tensors."""

import hashlib
import json
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnxscript import ir
from pydantic import BaseModel
from torch import Tensor, nn

from nlos_cam.files import cache_folder, load_cached, write_checked
from nlos_models import inference
from nlos_models.arrays import Float32
from nlos_models.byte_weights import SCALE, from_bytes, group_of
from nlos_models.checkpoint import load_network
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError, ModelError
from nlos_models.pipeline import RemappingNetwork
from nlos_models.records import (
    SIMULATION_ONLY,
    UNCERTAINTY,
    CheckpointRecord,
    checksum_of_watched,
    watched_files,
)
from nlos_models.uncertainty_network import load_uncertainty_network

OPSET = 18
IR_VERSION = 10
"""ONNX Runtime 1.20 reads both."""
TRACES = "traces"
"""Folder in the cache: of graphs by their network's architecture."""
NORM_EPSILON = np.float32(1e-5)
"""Of torch's batch norms."""


class TorchReconstructor:
    """Pipeline in torch, for a GPU, and the reference of the exported graphs."""

    def __init__(
        self, pipeline: RemappingNetwork | DirectNetwork, record: CheckpointRecord, device: str
    ) -> None:
        self.record = record
        self.runtime = f"torch on {device}"
        self._network = _Answering(pipeline.to(device).eval())
        self._device = device

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        return self.answer(depth_m, intensity).image

    def answer(self, depth_m: Float32, intensity: Float32) -> inference.Answer:
        maps = [
            torch.from_numpy(np.ascontiguousarray(each)).to(self._device)
            for each in (depth_m, intensity)
        ]
        with torch.inference_mode():
            answer = self._network(*maps)
        return inference.Answer(*(each.float().cpu().numpy() for each in answer))


class _Answering(nn.Module):
    """Network whose outputs are those of an Answer."""

    def __init__(self, network: RemappingNetwork | DirectNetwork) -> None:
        super().__init__()
        self.network = network

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs: those of `forward`, as an Answer has them."""
        has_surface = isinstance(self.network, DirectNetwork)
        return ["image", "surface"] if has_surface else ["image"]

    def forward(self, depth_m: Tensor, intensity: Tensor) -> tuple[Tensor, ...]:
        """Return the images of maps, and a direct network's probability of a surface."""
        if isinstance(self.network, DirectNetwork):
            return self.network.answer(depth_m, intensity)
        return (self.network(depth_m, intensity),)


def load_torch_reconstructor(folder: Path) -> TorchReconstructor:
    """Load a checkpoint folder's weights on the GPU."""
    return TorchReconstructor(*load_network(folder), "cuda")


UNCERTAINTY_OUTPUTS = list(inference.UncertaintyEstimate._fields)


def export_folder(folder: Path) -> list[Path]:
    """Write the ONNX graphs of a checkpoint folder's networks beside their tensors, for inference
    without torch.

    Raises CheckpointError where the weights cannot be read or are for color.
    """
    network, record = load_network(folder)
    inference.refuse_color(record, folder)
    files = watched_files(folder)
    answering = _Answering(network)
    if record.direct_recipe:
        names = {"": files[0]}
    else:
        names = {f"{name.partition('.')[0]}.": name for name in files}
    parts = {f"network.{prefix}": name for prefix, name in names.items()}
    graphs = {
        inference.NETWORK_ONNX: _linked_graph(
            answering, folder, inference.NETWORK_INPUTS, answering.outputs, parts, files
        )
    }
    if loaded := load_uncertainty_network(folder):
        parts = {"network.": inference.UNCERTAINTY_FILES[0]}
        graphs[inference.UNCERTAINTY_ONNX] = _linked_graph(
            loaded[0],
            folder,
            inference.UNCERTAINTY_INPUTS,
            UNCERTAINTY_OUTPUTS,
            parts,
            inference.UNCERTAINTY_FILES,
        )
    write_checked(folder, graphs)
    return [folder / name for name in graphs]


Export = tuple[str, Callable[[], bytes]]
"""File name in a cache, and the function that makes its content: a self-contained ONNX file."""


def network_export(folder: Path) -> Export:
    """Return the export of a folder's pipeline. Raises CheckpointError."""
    pipeline = load_network(folder)[0]
    return f"{checksum_of(pipeline)}.onnx", partial(export_onnx, pipeline)


def uncertainty_export(folder: Path) -> Export:
    """Return the export of a folder's uncertainty network. Raises CheckpointError."""
    if not (loaded := load_uncertainty_network(folder)):
        raise CheckpointError(f"{folder} has no uncertainty network: train one with `train doubt`")
    return f"{UNCERTAINTY}-{checksum_of(loaded[0])}.onnx", partial(
        write_onnx, loaded[0], inference.UNCERTAINTY_INPUTS, UNCERTAINTY_OUTPUTS
    )


def export_onnx(pipeline: RemappingNetwork | DirectNetwork) -> bytes:
    """Return the pipeline, preprocessing included, as an ONNX file for any batch size. Raises
    ModelError for color.
    """
    if pipeline.intensities > 1:
        raise ModelError(
            f"color networks ({SIMULATION_ONLY}) cannot be exported: use them in torch"
        )
    answering = _Answering(pipeline)
    return write_onnx(answering, inference.NETWORK_INPUTS, answering.outputs)


def write_onnx(
    network: nn.Module, inputs: Mapping[str, tuple[int, int]], outputs: list[str]
) -> bytes:
    """Return a network as an ONNX file for any batch size n; inputs are (n, *shape) by name."""
    return _as_onnx(network, inputs, outputs).SerializeToString()


def _as_onnx(
    network: nn.Module, inputs: Mapping[str, tuple[int, int]], outputs: list[str]
) -> onnx.ModelProto:
    """Return a network as torch's exporter makes it.

    The exporter traces a network for tens of seconds, and the trace depends on its architecture
    alone: it is kept in the cache without weights, and those of this network are entered.
    """
    network = network.eval()
    weights = {name: tensor.numpy(force=True) for name, tensor in network.state_dict().items()}

    def entered(trace: bytes) -> onnx.ModelProto:
        # Before the optimizer runs, which folds weights into other numbers: there, the exporter's
        # initializers have the names and the values of torch's.
        model = onnx.ModelProto.FromString(trace)
        for initializer in model.graph.initializer:
            if initializer.name in weights:
                values = numpy_helper.from_array(weights[initializer.name], initializer.name)
                initializer.CopyFrom(values)
        return model

    # An entry that another version made has another name, as the code is in its checksum.
    path = cache_folder() / TRACES / f"{_architecture_of(network, inputs, outputs)}.onnx"
    model = load_cached(path, entered, lambda: _trace(network, inputs, outputs))
    # The same passes as in an export of the whole: its graph is the same but for names of values.
    program = torch.onnx.ONNXProgram(ir.serde.deserialize_model(model), None)
    program.optimize()
    return program.model_proto


def _trace(network: nn.Module, inputs: Mapping[str, tuple[int, int]], outputs: list[str]) -> bytes:
    """Return the ONNX graph of a network's architecture, not optimized: its weights are empty."""
    # The exporter reports its passes at the level of warnings.
    for noisy in ("onnxscript", "torch.onnx"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
        program = torch.onnx.export(
            network,
            # Two samples: with one, the exporter takes the batch for a constant.
            tuple(torch.ones(2, *shape) for shape in inputs.values()),
            dynamo=True,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=tuple({0: torch.export.Dim("n")} for _ in inputs),
            opset_version=OPSET,
            verbose=False,
            optimize=False,  # which folds weights into other numbers
        )
    if program is None:
        raise ModelError(
            "torch's exporter returned no ONNX program: install a torch between 2.6 and 2.13"
        )
    model = program.model_proto
    model.ir_version = IR_VERSION
    # Forty megabytes that are another network's the next time: what is kept has their names.
    names = set(network.state_dict())
    for initializer in model.graph.initializer:
        if initializer.name in names:
            initializer.ClearField("raw_data")
    for node in model.graph.node:  # places in the source
        node.doc_string = ""
        del node.metadata_props[:]
    return model.SerializeToString()


def _architecture_of(
    network: nn.Module, inputs: Mapping[str, tuple[int, int]], outputs: list[str]
) -> str:
    """Return a checksum of all that a trace depends on: exporter, this package's code, the modules
    and their settings, and the shapes of their weights.
    """
    digest = _digest_of_code()
    digest.update(repr((sorted(inputs.items()), outputs)).encode())
    # A setting that no weight's shape shows, such as a norm's epsilon, makes another graph.
    for name, module in network.named_modules():
        settings = {
            key: value
            for key, value in vars(module).items()
            if not key.startswith("_")
            and isinstance(value, bool | int | float | str | tuple | BaseModel)
        }
        digest.update(repr((name, type(module).__qualname__, sorted(settings.items()))).encode())
    weights = network.state_dict()
    for name, tensor in sorted(weights.items()):
        digest.update(repr((name, tuple(tensor.shape), str(tensor.dtype))).encode())
    for name, tensor in sorted(network.named_buffers()):
        if name not in weights:  # a constant of the trace
            digest.update(name.encode() + tensor.contiguous().numpy(force=True).tobytes())
    return digest.hexdigest()[:16]


KINDS = {"F16": "<f2", "F32": "<f4", "I8": "<i1"}
"""NumPy's names of the types of safetensors files that are linked."""
ONNX_TYPES = {"f2": TensorProto.FLOAT16, "f4": TensorProto.FLOAT, "i1": TensorProto.INT8}


class _StoredTensor(NamedTuple):
    """Tensor in a safetensors file, and its place there in bytes."""

    values: NDArray[Any]
    """In float16, float32, or bytes."""
    location: str
    offset: int
    length: int
    scale: "_StoredTensor | None" = None
    """Of a weight in bytes (`byte_weights`)."""

    @property
    def is_linked(self) -> bool:
        """Return True for a large weight; biases and norms are small, and stay in the graph."""
        return self.values.ndim > 1 and self.values.dtype != np.float32

    @property
    def plain(self) -> Float32:
        """Values in float32, as networks compute with them."""
        if self.scale:
            return from_bytes(self.values, self.scale.values)
        return self.values.astype(np.float32)


def _stored(path: Path, prefix: str) -> dict[str, _StoredTensor]:
    """Return the tensors of a safetensors file: the header's length (8 bytes), the header (JSON),
    then the tensors.
    """
    # https://huggingface.co/docs/safetensors: offsets in the header count from the end of the
    # header.
    content = path.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    found = dict[str, _StoredTensor]()
    for name, entry in json.loads(content[8:start]).items():
        if name != "__metadata__" and entry["dtype"] in KINDS:
            first, last = (start + offset for offset in entry["data_offsets"])
            values = np.frombuffer(content[first:last], KINDS[entry["dtype"]])
            found[name] = _StoredTensor(
                values.reshape(entry["shape"]), path.name, first, last - first
            )
    return {
        prefix + name: tensor._replace(scale=found.get(name + SCALE))
        for name, tensor in found.items()
        if not name.endswith(SCALE)
    }


def _linked_graph(
    network: nn.Module,
    folder: Path,
    inputs: Mapping[str, tuple[int, int]],
    outputs: list[str],
    parts: Mapping[str, str],
    sources: Sequence[str],
) -> bytes:
    """Return an ONNX file whose large weights are external data in the safetensors files of a
    folder.

    `parts` has the file of tensors by the prefix of their names in the network; `sources` go into
    the checksum.
    """
    model = _as_onnx(network, inputs, outputs)
    stored = dict[str, _StoredTensor]()
    for prefix, name in parts.items():
        stored.update(_stored(folder / name, prefix))

    # The exporter names a weight as torch does, unless it has transposed it for a matrix product:
    # such a one is found by its values.
    transposed = {
        _key(tensor.plain.T): tensor
        for tensor in stored.values()
        if tensor.is_linked and tensor.values.ndim == 2
    }
    nodes = list[onnx.NodeProto]()
    initializers = {initializer.name: initializer for initializer in model.graph.initializer}
    for name, initializer in sorted(initializers.items()):
        values = numpy_helper.to_array(initializer)
        linked = None
        if name in stored:
            linked = _linked(name, values, stored)
        elif values.ndim == 2 and (tensor := transposed.get(_key(values))):
            linked = _linked_transposed(name, tensor)
        if linked:
            model.graph.initializer.remove(initializer)
            model.graph.initializer.extend(linked[0])
            nodes += linked[1]

    # A graph's nodes are in the order of their use: those that make weights come first.
    rest = list(model.graph.node)
    del model.graph.node[:]
    model.graph.node.extend([*nodes, *rest])
    helper.set_model_props(model, {inference.CHECKSUM: checksum_of_watched(folder, sources)})
    return model.SerializeToString()


def _key(values: NDArray[Any]) -> tuple[tuple[int, ...], bytes]:
    return values.shape, np.ascontiguousarray(values, np.float32).tobytes()


Linked = tuple[list[TensorProto], list[onnx.NodeProto]]
"""Initializers, and the nodes that make a weight from them."""


def _linked_transposed(name: str, tensor: _StoredTensor) -> Linked:
    """Return what makes a weight that the exporter has transposed."""
    initializers, nodes = _plain(f"{name}.plain", tensor)
    transpose = helper.make_node("Transpose", [f"{name}.plain"], [name], perm=[1, 0])
    return initializers, [*nodes, transpose]


def _plain(name: str, tensor: _StoredTensor) -> Linked:
    """Return what makes a weight in float32 from its stored tensor."""
    stored = f"{name}.stored"
    scale = tensor.scale
    if scale is None:
        cast = helper.make_node("Cast", [stored], [name], to=TensorProto.FLOAT)
        return [_external(stored, tensor, tensor.values.shape)], [cast]

    # the same products as `from_bytes`: a graph answers as torch does
    group = group_of(tensor.values, scale.values)
    initializers = [
        _external(stored, tensor, (tensor.values.size // group, group)),
        _external(f"{name}.scale.stored", scale, scale.values.shape),
        numpy_helper.from_array(np.array(tensor.values.shape, np.int64), f"{name}.shape"),
    ]
    nodes = [
        helper.make_node("Cast", [stored], [f"{name}.whole"], to=TensorProto.FLOAT),
        helper.make_node("Cast", [f"{name}.scale.stored"], [f"{name}.scale"], to=TensorProto.FLOAT),
        helper.make_node("Mul", [f"{name}.whole", f"{name}.scale"], [f"{name}.groups"]),
        helper.make_node("Reshape", [f"{name}.groups", f"{name}.shape"], [name]),
    ]
    return initializers, nodes


def _external(name: str, tensor: _StoredTensor, shape: Sequence[int]) -> TensorProto:
    # ONNX external data: file, offset and length, so that the weights are stored once.
    kind = ONNX_TYPES[tensor.values.dtype.str[1:]]
    external = TensorProto(name=name, data_type=kind, dims=shape)
    external.data_location = TensorProto.EXTERNAL
    for key, value in (
        ("location", tensor.location),
        ("offset", tensor.offset),
        ("length", tensor.length),
    ):
        external.external_data.add(key=key, value=str(value))
    return external


def _linked(
    name: str, exported: NDArray[Any], stored: Mapping[str, _StoredTensor]
) -> Linked | None:
    """Return what makes an exported weight from its stored tensor; None for small ones.

    The exporter multiplies the weights of a convolution by gamma / sqrt(variance + epsilon) of the
    batch norm after it. The same product is left to ONNX Runtime, which computes constants once,
    when it opens the graph.
    """
    tensor = stored[name]
    if not tensor.is_linked:
        return None
    plain = tensor.plain
    if np.array_equal(exported, plain):
        return _plain(name, tensor)
    # In a Sequential the batch norm has the number after its convolution's. Its factor has to be
    # computed as the exporter did, to the last bit, or the weight is not linked.
    module, _, index = name.removesuffix(".weight").rpartition(".")
    norm = f"{module}.{int(index) + 1}" if index.isdecimal() else ""
    if f"{norm}.running_var" not in stored:
        return None
    gamma = stored[f"{norm}.weight"].values
    variance = stored[f"{norm}.running_var"].values
    scale = gamma.astype(np.float32) / np.sqrt(variance + NORM_EPSILON)
    factor = scale.reshape(-1, *[1] * (plain.ndim - 1))
    if not np.array_equal(exported, plain * factor):
        return None
    initializers, nodes = _plain(f"{name}.plain", tensor)
    product = helper.make_node("Mul", [f"{name}.plain", f"{norm}.scale"], [name])
    factors = numpy_helper.from_array(factor, f"{norm}.scale")
    return [*initializers, factors], [*nodes, product]


def checksum_of(network: nn.Module) -> str:
    """Return a checksum of all that an exported network depends on: exporter, weights and this
    package's code.
    """
    digest = _digest_of_code()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode() + tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _digest_of_code() -> Any:
    """Return a digest of the exporter and this package's code: a changed forward pass exports to
    another graph.
    """
    digest = hashlib.sha256(f"{torch.__version__} {OPSET}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest
