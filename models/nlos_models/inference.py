"""Inference from maps to images and uncertainty in ONNX Runtime on a CPU, without torch; with a
GPU, in torch.
"""

import ctypes
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from nlos_cam.files import TENSOR_LIMIT, load_cached, read_checked
from nlos_models import records
from nlos_models.arrays import Float32
from nlos_models.errors import CheckpointError, MissingExtraError, lacks_memory, require
from nlos_models.quality import UNCERTAINTY_FILES, QualityModel, load_quality_model
from nlos_models.quality_figures import UncertaintyEstimate

MAP_SHAPE = (64, 80)
NETWORK_INPUTS = {"depth_m": MAP_SHAPE, "intensity": MAP_SHAPE}
UNCERTAINTY_INPUTS = {**NETWORK_INPUTS, "image": (64, 64)}
NETWORK_ONNX = "network.onnx"
UNCERTAINTY_ONNX = "doubt.onnx"
"""Graphs beside a checkpoint's tensors, which they point into as ONNX external data: nothing is
stored twice.
"""
CHECKSUM = "weights"
"""Key of the graph's metadata with the checksum of the files that it was made from."""


class Answer(NamedTuple):
    """Answer of a network to n maps."""

    image: Float32
    """(n, 64, 64) in [0, 1]."""
    surface: Float32 | None = None
    """(n, 64, 64): probability that there is a surface; None for a network without such a head."""


class Reconstructor(Protocol):
    """Trained pipeline that is ready to run."""

    record: records.CheckpointRecord
    runtime: str

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        """Return the images (n, 64, 64) in [0, 1] of maps (n, 64, 80) with NaN depth where there is
        no return.
        """
        ...


@runtime_checkable
class _HasSurface(Protocol):
    def answer(self, depth_m: Float32, intensity: Float32) -> Answer: ...


def ask(
    network: Callable[[Float32, Float32], Float32], depth_m: Float32, intensity: Float32
) -> Answer:
    """Return a network's answer to maps (n, 64, 80), with the probability of a surface where its
    `answer` has one.
    """
    # Any function of maps is a network, in tests and for a user's own; the second head is
    # optional.
    if isinstance(network, _HasSurface):
        return network.answer(depth_m, intensity)
    return Answer(network(depth_m, intensity))


class OnnxReconstructor:
    """Pipeline in ONNX Runtime on the CPU, about five times faster than torch there for one
    frame.
    """

    def __init__(
        self,
        model: Path | bytes,
        record: records.CheckpointRecord,
        checksum: str = "",
    ) -> None:
        self.record = record
        self.runtime = "ONNX Runtime on cpu"
        self._session = open_session(model, checksum)

    def __call__(self, depth_m: Float32, intensity: Float32) -> Float32:
        return self.answer(depth_m, intensity).image

    def answer(self, depth_m: Float32, intensity: Float32) -> Answer:
        inputs = {
            "depth_m": np.ascontiguousarray(depth_m),
            "intensity": np.ascontiguousarray(intensity),
        }
        return Answer(*self._session.run(None, inputs))


class UncertaintyModel(Protocol):
    """Uncertainty network that is ready to run."""

    record: records.UncertaintyRecord
    quality: QualityModel | None
    """None for weights without a quality model."""

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> UncertaintyEstimate:
        """Return the uncertainty of images (n, 64, 64) reconstructed from maps (n, 64, 80) with NaN
        for no return.
        """
        ...


class OnnxUncertaintyModel:
    """Uncertainty network in ONNX Runtime on the CPU."""

    def __init__(
        self, model: Path | bytes, record: records.UncertaintyRecord, checksum: str = ""
    ) -> None:
        self.record = record
        self._session = open_session(model, checksum)
        self.quality: QualityModel | None = None

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> UncertaintyEstimate:
        arrays = (np.ascontiguousarray(array, np.float32) for array in (depth_m, intensity, image))
        return UncertaintyEstimate(
            *self._session.run(None, dict(zip(UNCERTAINTY_INPUTS, arrays, strict=True)))
        )


def open_session(model: Path | bytes, checksum: str = "") -> Any:
    """Open an ONNX file, or its content, in ONNX Runtime on the CPU.

    Raises CheckpointError where it cannot be read, or was made from other weights than those of
    `checksum`.
    """
    try:
        import onnxruntime
    except ImportError as error:  # also where its libraries do not fit into the memory that is left
        reason = " ".join(str(error).split())
        raise MissingExtraError(
            f"ONNX Runtime cannot be loaded ({reason}): free memory or install it again"
        ) from error
    options = onnxruntime.SessionOptions()
    # One thread: a frame's products are too small to be worth the hand-over between threads, and
    # the other cores have the camera, the view and the check by physics.
    options.intra_op_num_threads = 1
    # Errors are raised too; a log of a library on stderr would break the command's own output.
    options.log_severity_level = 4
    name = model if isinstance(model, Path) else "the cached network"
    try:
        if isinstance(model, Path):
            read_checked(model, TENSOR_LIMIT)
        # A graph in a folder is opened by its path, since it points into the weights beside it.
        source = model if isinstance(model, bytes) else str(model)
        session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors share no class below Exception
        if lacks_memory(error):
            raise MemoryError(str(error)) from error
        raise CheckpointError(f"{name} cannot be read as a network: export it again") from error
    # A graph beside other tensors would answer, and wrongly: offsets of another file are still
    # numbers.
    if checksum and session.get_modelmeta().custom_metadata_map.get(CHECKSUM) != checksum:
        raise CheckpointError(
            f"{name} was made from other weights than those beside it: export it again"
        )
    return session


def load_reconstructor(folder: Path | None, cache: Path) -> Reconstructor:
    """Load a checkpoint folder's weights (None: the shipped ones) on a GPU if there is one, else in
    ONNX Runtime.

    Weights without a valid graph beside them are exported into the
    folder `cache`, which takes torch. Raises CheckpointError where they cannot be read or are for
    color, MissingExtraError without torch.
    """
    folder = records.weights_folder(folder)
    record = records.load_record(folder)
    refuse_color(record, folder)
    # Without torch where it can be: importing it takes seconds. A GPU needs it.
    if _has_cuda():
        return require("nlos_models.export", "inference on a GPU").load_torch_reconstructor(folder)
    try:
        return OnnxReconstructor(folder / NETWORK_ONNX, record, records.checksum_of_watched(folder))
    except CheckpointError as error:
        key, export = _exporter(error).network_export(folder)
        return load_cached(cache / key, lambda model: OnnxReconstructor(model, record), export)


def load_uncertainty_model(
    folder: Path | None, cache: Path, *, quality: bool = True
) -> UncertaintyModel | None:
    """Load the uncertainty network beside the weights in a folder (None: the shipped ones); None
    where there is none.

    With it comes the quality model that watches it, if there is one; without `quality` that file is
    not read.

    Without a valid graph it is exported as by `load_reconstructor`. Raises CheckpointError,
    MissingExtraError.
    """
    folder = records.weights_folder(folder)
    if (record := records.load_uncertainty_record(folder)) is None:
        return None
    try:
        loaded = OnnxUncertaintyModel(
            folder / UNCERTAINTY_ONNX,
            record,
            checksum=records.checksum_of_watched(folder, UNCERTAINTY_FILES),
        )
    except CheckpointError as error:
        key, export = _exporter(error).uncertainty_export(folder)
        loaded = load_cached(cache / key, lambda model: OnnxUncertaintyModel(model, record), export)
    loaded.quality = load_quality_model(folder) if quality else None
    return loaded


def refuse_color(record: records.CheckpointRecord, folder: Path | None) -> None:
    """Raise CheckpointError for color weights: exports and runtimes are for depth."""
    if record.color:
        raise CheckpointError(
            f"{folder} holds weights for full color ({records.SIMULATION_ONLY}): name weights for"
            " depth, or evaluate these with tools/studies/color.py"
        )


def _exporter(error: CheckpointError) -> Any:
    """Return the export module. Raises MissingExtraError, with the reason why it is needed."""
    try:
        return require("nlos_models.export", "export")
    except MissingExtraError as missing:
        raise MissingExtraError(f"{error}; {missing}") from missing


def _has_cuda() -> bool:
    """Return whether torch can use a GPU; torch is imported only where NVIDIA's driver is
    installed.
    """
    try:
        # The driver's library, since asking torch would import it.
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    try:
        return require("torch", "a GPU").cuda.is_available()
    except MissingExtraError:
        return False
