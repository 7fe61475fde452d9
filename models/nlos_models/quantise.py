"""An exported pipeline with its weights, and with samples its activations too, in 8-bit integers (ONNX Runtime)."""

import logging
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from nlos_models.arrays import Float32
from nlos_models.errors import ModelError

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
