"""Inference from maps to images: ONNX Runtime on a CPU, torch on a GPU, and quantisation to 8-bit integers."""

import hashlib
import logging
import os
import warnings
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
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
    """Trained pipeline that is ready to run."""

    record: CheckpointRecord
    runtime: str

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        """Return the images (n, 64, 64) in [0, 1] of maps (n, 64, 80) with NaN depth where there is no return."""
        ...


class TorchReconstructor:
    """Pipeline in torch; in float32 it is the reference for the others."""

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
    """Pipeline in ONNX Runtime on the CPU, about five times faster than torch there for one frame."""

    def __init__(self, model: Path, record: CheckpointRecord, threads: int = 1) -> None:
        self.record, self.runtime = record, "ONNX Runtime on cpu"
        self._session = open_session(model, threads)

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        inputs = {"depth_m": np.ascontiguousarray(depth_m), "intensity": np.ascontiguousarray(intensity)}
        return self._session.run(None, inputs)[0]


def open_session(model: Path, threads: int = 1) -> Any:
    """Open an ONNX file in ONNX Runtime on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])


def load_reconstructor(folder: Path | None, cache: Path) -> Reconstructor:
    """Load a checkpoint folder's weights (None: the shipped ones) on a GPU if there is one, else in ONNX Runtime.

    The ONNX file is exported once into the folder `cache`, named by a checksum of weights and code. Raises
    CheckpointError where the weights cannot be read or are for color.
    """
    pipeline, record = load_pipeline(folder)
    refuse_color(record, folder)
    if torch.cuda.is_available():
        return TorchReconstructor(pipeline, record, "cuda")
    return OnnxReconstructor(export_once(pipeline, cache), record)


def refuse_color(record: CheckpointRecord, folder: Path | None) -> None:
    """Raise CheckpointError for color weights: exports and runtimes are for depth."""
    if record.color:
        raise CheckpointError(
            f"{folder} holds weights for full color ({SIMULATION_ONLY}): name weights for depth, or evaluate these "
            "with tools/studies/color.py"
        )


def export_once(pipeline: RemappingNetwork, cache: Path) -> Path:
    """Return the pipeline's ONNX file in the folder `cache`; write it where it is missing."""
    model = cache / f"{checksum_of(pipeline)}.onnx"
    if not model.exists():
        export_onnx(pipeline, model)
    return model


def export_onnx(pipeline: RemappingNetwork, path: Path) -> None:
    """Write the pipeline, preprocessing included, as an ONNX file for any batch size. Raises ModelError for color."""
    if pipeline.intensities > 1:
        raise ModelError(f"color networks ({SIMULATION_ONLY}) cannot be exported: use them in torch")
    write_onnx(pipeline, path, {"depth_m": MAP_SHAPE, "intensity": MAP_SHAPE}, ["image"])


def write_onnx(network: nn.Module, path: Path, inputs: Mapping[str, tuple[int, int]], outputs: list[str]) -> None:
    """Write a network as an ONNX file for any batch size n; inputs are (n, *shape) by name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for noisy in ("onnxscript", "torch.onnx"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
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
    with _replaced(path) as part:
        program.save(part, external_data=False)


@contextmanager
def _replaced(path: Path) -> Generator[Path]:
    """Yield a temporary path of this process, renamed to `path` if the block succeeds, else deleted."""
    part = path.with_name(f"{path.stem}.{os.getpid()}.part.onnx")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def checksum_of(network: nn.Module) -> str:
    """Return a checksum of all that an exported network depends on: exporter, weights and this package's code."""
    digest = hashlib.sha256(f"{torch.__version__} {OPSET}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode() + tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


Sample = tuple[Float32, Float32]
"""Depth and intensity maps, each (n, 64, 80)."""
QUANTIZED = ["Conv", "MatMul", "Gemm"]
"""Operators with nearly all of the work; the rest is preprocessing, activations and the silhouette."""


def quantize(model: Path, path: Path, samples: Iterable[Sample] | None = None) -> None:
    """Write `model` with 8-bit weights; given samples, also with 8-bit activations, whose ranges come from them.

    Raises ModelError where ONNX Runtime fails.
    """
    import onnx
    from onnxruntime import quantization

    plain = onnx.load(model)
    del plain.graph.value_info[:]  # shapes from the exporter; they are wrong after the quantizer transposes a Gemm
    logging.getLogger().addFilter(_is_no_advice)  # advice to preprocess the model, sent through the root logger
    try:
        with _replaced(path) as part:
            if samples is None:
                quantization.quantize_dynamic(plain, part, op_types_to_quantize=QUANTIZED)
            else:
                quantization.quantize_static(
                    plain, part, _reader(samples), op_types_to_quantize=QUANTIZED, per_channel=True
                )
    except (RuntimeError, ValueError, OSError) as error:
        raise ModelError(f"{model} cannot be quantised to 8 bits ({error}): use it as it is") from error
    finally:
        logging.getLogger().removeFilter(_is_no_advice)


def _is_no_advice(record: logging.LogRecord) -> bool:
    return "pre-processing before quantization" not in record.getMessage()


def _reader(samples: Iterable[Sample]) -> Any:
    from onnxruntime.quantization import CalibrationDataReader

    class Reader(CalibrationDataReader):
        """Reader of samples, one at a time; None at the end."""

        def __init__(self) -> None:
            self._rest: Iterator[Sample] = iter(samples)

        def get_next(self) -> Any:
            sample = next(self._rest, None)
            return None if sample is None else dict(zip(("depth_m", "intensity"), sample, strict=True))

    return Reader()
