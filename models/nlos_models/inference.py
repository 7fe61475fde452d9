"""Inference: maps in, images out; ONNX Runtime on a CPU, torch on a GPU.

An exported pipeline with its weights, and with samples its activations too, in 8-bit integers (ONNX Runtime).
"""

import hashlib
import logging
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from nlos_models.arrays import Float32
from nlos_models.checkpoint import CheckpointRecord, load_pipeline
from nlos_models.errors import CheckpointError, ModelError
from nlos_models.pipeline import RemappingNetwork
from nlos_models.recipe import SIMULATION_ONLY

MAP_SHAPE = (64, 80)
OPSET = 18


class Reconstructor(Protocol):
    """A trained pipeline, ready to run."""

    record: CheckpointRecord
    runtime: str

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        """Maps (n, 64, 80), NaN depth where there is no return, to images (n, 64, 64) in [0, 1]."""
        ...


class TorchReconstructor:
    """The pipeline as torch runs it; in float32 the definition that the others are held against."""

    def __init__(
        self, pipeline: RemappingNetwork, record: CheckpointRecord, device: str, dtype: torch.dtype = torch.float32
    ) -> None:
        self.record, self.runtime = record, f"torch on {device}"
        self._pipeline, self._device, self._dtype = pipeline.to(device).eval(), device, dtype

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        mixed = torch.autocast(self._device, self._dtype, enabled=self._dtype != torch.float32)
        with torch.inference_mode(), mixed:
            maps = [torch.from_numpy(np.ascontiguousarray(m)).to(self._device) for m in (depth_m, intensity)]
            return self._pipeline(*maps).float().cpu().numpy()


class OnnxReconstructor:
    """The pipeline exported to ONNX and run by ONNX Runtime: about five times faster than torch at batch 1."""

    def __init__(self, model: Path, record: CheckpointRecord, threads: int = 1) -> None:
        self.record, self.runtime = record, "ONNX Runtime on cpu"
        self._session = open_session(model, threads)

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        inputs = {"depth_m": np.ascontiguousarray(depth_m), "intensity": np.ascontiguousarray(intensity)}
        return self._session.run(None, inputs)[0]


def open_session(model: Path, threads: int = 1) -> Any:
    """An ONNX file ready to run on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])


def load_reconstructor(folder: Path | None, cache: Path) -> Reconstructor:
    """The shipped weights (None), or a checkpoint folder's, on the best device at hand.

    The ONNX file is exported once into the folder `cache`, named by a checksum of weights and code.
    Raises CheckpointError where the weights cannot be read, or are for colour.
    """
    pipeline, record = load_pipeline(folder)
    refuse_colour(record, folder)
    if torch.cuda.is_available():
        return TorchReconstructor(pipeline, record, "cuda")
    return OnnxReconstructor(exported(pipeline, cache), record)


def refuse_colour(record: CheckpointRecord, folder: Path | None) -> None:
    """Raise CheckpointError for weights of full colour: what runs here, and is exported, reconstructs depth."""
    if record.colour:
        raise CheckpointError(
            f"{folder} holds weights for full colour ({SIMULATION_ONLY}): name weights for depth; "
            "tools/colour_demo.py judges these"
        )


def exported(pipeline: RemappingNetwork, cache: Path) -> Path:
    """The pipeline's ONNX file in the folder `cache`, written unless it is there."""
    model = cache / f"{checksum_of(pipeline)}.onnx"
    if not model.exists():
        export_onnx(pipeline, model)
    return model


def export_onnx(pipeline: RemappingNetwork, path: Path) -> None:
    """Write the whole pipeline, preprocessing included, as one ONNX file with a free batch size.

    Raises ModelError for one of full colour.
    """
    if pipeline.intensities > 1:
        raise ModelError(f"networks of full colour ({SIMULATION_ONLY}) are not exported: use them in torch")
    write_onnx(pipeline, path, {"depth_m": MAP_SHAPE, "intensity": MAP_SHAPE}, ["image"])


def write_onnx(network: nn.Module, path: Path, inputs: Mapping[str, tuple[int, int]], outputs: list[str]) -> None:
    """Write a network of inputs (n, rows, columns), by name, as one ONNX file with a free n."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.{os.getpid()}.part.onnx")
    for noisy in ("onnxscript", "torch.onnx"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of its own internals
        program = torch.onnx.export(
            network.eval(),
            tuple(torch.ones(2, *shape) for shape in inputs.values()),
            dynamo=True,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=tuple({0: torch.export.Dim("n")} for _ in inputs),
            opset_version=OPSET,
            verbose=False,
        )
    if program is None:
        raise ModelError("torch's exporter returned no ONNX program: install a torch between 2.6 and 2.13")
    try:
        program.save(part, external_data=False)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def checksum_of(network: nn.Module) -> str:
    """Of all that decides what an exported network computes: exporter, weights, and this package's own code."""
    digest = hashlib.sha256(f"{torch.__version__} {OPSET}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode() + tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


Sample = tuple[Float32, Float32]
"""Depth and intensity maps, each (n, 64, 80)."""

QUANTISED = ("Conv", "MatMul", "Gemm")
"""Nearly all of the work; what is left over is the preprocessing, activations and the silhouette."""


def quantise(model: Path, path: Path, samples: Iterable[Sample] | None = None) -> None:
    """Write `model` with 8-bit weights; with samples, from which their ranges are learnt, with 8-bit activations too.

    Raises ModelError where ONNX Runtime cannot, with its reason.
    """
    import onnx
    from onnxruntime import quantization

    plain = onnx.load(model)
    del plain.graph.value_info[:]  # the exporter's shapes; the quantiser turns a Gemm about and trips over them
    part = path.with_name(f"{path.stem}.{os.getpid()}.part.onnx")
    logging.getLogger().addFilter(_no_advice)  # it advises, through the root logger, to prepare the model first
    try:
        if samples is None:
            quantization.quantize_dynamic(plain, part, op_types_to_quantize=list(QUANTISED))
        else:
            quantization.quantize_static(
                plain, part, _reader(samples), op_types_to_quantize=list(QUANTISED), per_channel=True
            )
        part.replace(path)
    except (RuntimeError, ValueError, OSError) as error:
        raise ModelError(f"{model} cannot be made 8-bit: {error}; use it as it is") from error
    finally:
        part.unlink(missing_ok=True)
        logging.getLogger().removeFilter(_no_advice)


def _no_advice(record: logging.LogRecord) -> bool:
    return "pre-processing before quantization" not in record.getMessage()


def _reader(samples: Iterable[Sample]) -> Any:
    from onnxruntime.quantization import CalibrationDataReader

    class Reader(CalibrationDataReader):
        """Samples one by one, None at the end."""

        def __init__(self) -> None:
            self._rest: Iterator[Sample] = iter(samples)

        def get_next(self) -> Any:
            sample = next(self._rest, None)
            return None if sample is None else dict(zip(("depth_m", "intensity"), sample, strict=True))

    return Reader()
