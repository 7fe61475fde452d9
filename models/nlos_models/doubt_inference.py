"""Doubt at run time: a doubt network exported to ONNX and run by ONNX Runtime on one thread of a CPU."""

from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from nlos_models.arrays import Float32
from nlos_models.checkpoint import shipped_folder
from nlos_models.doubt_network import MAP_SHAPE
from nlos_models.doubt_weights import DoubtRecord, load_doubt
from nlos_models.inference import checksum_of, open_session, write_onnx

INPUTS = {"depth_m": MAP_SHAPE, "intensity": MAP_SHAPE, "image": (64, 64)}


class SaidOf(NamedTuple):
    """What is said of n reconstructions, calibrated."""

    nothing: Float32
    """(n,); probability that nothing is hidden."""
    outside: Float32
    """(n,); probability that what is hidden is unlike what the networks were trained on."""
    error_v: Float32
    """(n, 64, 64); expected absolute error in v, were there a surface."""
    surface: Float32
    """(n, 64, 64); probability that there is a surface."""


class Doubter(Protocol):
    """A doubt network, ready to run."""

    record: DoubtRecord

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> SaidOf:
        """Maps (n, 64, 80), NaN depth where there is no return, and the images (n, 64, 64) made of them."""
        ...


class OnnxDoubter:
    """A doubt network as ONNX Runtime runs it."""

    def __init__(self, model: Path, record: DoubtRecord, threads: int = 1) -> None:
        self.record, self._session = record, open_session(model, threads)

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> SaidOf:
        arrays = (np.ascontiguousarray(array, np.float32) for array in (depth_m, intensity, image))
        return SaidOf(*self._session.run(None, dict(zip(INPUTS, arrays, strict=True))))


def load_doubter(folder: Path | None, cache: Path) -> Doubter | None:
    """The doubt network beside the shipped weights (None), or beside those of a folder; None where there is none.

    The ONNX file is exported once into the folder `cache`. Raises CheckpointError as `load_doubt` does.
    """
    if (found := load_doubt(folder or shipped_folder())) is None:
        return None
    network, record = found
    model = cache / f"doubt-{checksum_of(network)}.onnx"
    if not model.exists():
        write_onnx(network, model, INPUTS, list(SaidOf._fields))
    return OnnxDoubter(model, record)
