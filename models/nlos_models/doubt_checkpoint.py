"""Files of an uncertainty ("doubt") network beside the weights that it watches, and its inference in ONNX Runtime."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nlos_models.arrays import Float32
from nlos_models.checkpoint import RECORD, load_part, save_parts, shipped_folder
from nlos_models.doubt_network import MAP_SHAPE, CalibratedDoubt, DoubtNetwork
from nlos_models.errors import CheckpointError
from nlos_models.inference import checksum_of, open_session, write_onnx
from nlos_models.recipe import Recipe

DOUBT, DOUBT_RECORD = "doubt", "doubt.json"
WATCHED = "compressor.safetensors", "preprocess.safetensors", "decoder.safetensors"


class DoubtRecord(BaseModel):
    """Watched weights, recipe, calibration and held-out figures of an uncertainty network."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    watches: str
    """`checksum_of_watched` of the weights whose images it judges."""
    recipe: Recipe
    learnt: list[str]
    """Kinds of outliers in its training set."""
    temperatures: tuple[float, float] = (1.0, 1.0)
    """Divisors of the logits of nothing and of outside (out of distribution)."""
    error_scale: float = Field(default=1.0, gt=0)
    """Factor of the expected error."""
    nothing_above: float = Field(default=0.5, ge=0, le=1)
    """Lowest probability of the verdict that nothing is hidden."""
    outside_above: float = Field(default=0.5, ge=0, le=1)
    """Lowest probability of the verdict that a frame is out of distribution (outside the trained range)."""
    figures: dict[str, float] = {}
    """Held-out figures at the end of training and of the calibration."""


def checksum_of_watched(folder: Path) -> str:
    """Return a checksum, 12 hexadecimal digits, of the files of a pipeline's weights. Raises CheckpointError."""
    digest = hashlib.sha256()
    for name in WATCHED:
        try:
            digest.update((folder / name).read_bytes())
        except OSError as error:
            raise CheckpointError(
                f"{folder / name} cannot be read: name a folder with a compressor's weights"
            ) from error
    return digest.hexdigest()[:12]


def save_doubt(folder: Path, network: DoubtNetwork, record: DoubtRecord, watched: Path) -> None:
    """Write an uncertainty network and its record into a folder, with a copy of the watched weights from elsewhere."""
    if checksum_of_watched(watched) != record.watches:
        raise CheckpointError(f"{watched} changed during the training of its uncertainty network: train again")
    text = json.dumps(record.model_dump(mode="json"), indent=2)
    save_parts(folder, {DOUBT: network}, {DOUBT_RECORD: text})
    if folder.resolve() != watched.resolve():
        for name in (*WATCHED, RECORD):
            shutil.copyfile(watched / name, folder / name)


def load_doubt(folder: Path) -> tuple[CalibratedDoubt, DoubtRecord] | None:
    """Return the calibrated uncertainty network beside a pipeline's weights in eval mode, or None where there is none.

    Raises CheckpointError where it cannot be read or watches other weights.
    """
    if not (folder / DOUBT_RECORD).exists():
        return None
    record = _record(folder / DOUBT_RECORD)
    if record.watches != (found := checksum_of_watched(folder)):
        raise CheckpointError(
            f"{folder / DOUBT_RECORD} watches other weights ({record.watches}) than those beside it ({found}): train "
            "it again with `train doubt`, or remove it"
        )
    network = DoubtNetwork()
    load_part(folder / f"{DOUBT}.safetensors", network)
    return CalibratedDoubt(network, record.temperatures, record.error_scale).eval(), record


def _record(path: Path) -> DoubtRecord:
    try:
        return DoubtRecord.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} cannot be read: train it again with `train doubt`") from error
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part) for part in problem["loc"])
        raise CheckpointError(f"{path} is not an uncertainty network's record: {field}: {problem['msg']}") from error


INPUTS = {"depth_m": MAP_SHAPE, "intensity": MAP_SHAPE, "image": (64, 64)}


class UncertaintyEstimate(NamedTuple):
    """Calibrated uncertainty of n reconstructions."""

    p_empty: Float32
    """(n,): probability that nothing is hidden."""
    p_out_of_distribution: Float32
    """(n,): probability that the hidden object is unlike the training objects."""
    error_v: Float32
    """(n, 64, 64): expected absolute error in v, given a surface."""
    p_surface: Float32
    """(n, 64, 64): probability that there is a surface."""


class UncertaintyModel(Protocol):
    """Uncertainty network that is ready to run."""

    record: DoubtRecord

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> UncertaintyEstimate:
        """Return the uncertainty of images (n, 64, 64) reconstructed from maps (n, 64, 80) with NaN for no return."""
        ...


class OnnxUncertaintyModel:
    """Uncertainty network in ONNX Runtime, on one thread of the CPU unless set otherwise."""

    def __init__(self, model: Path, record: DoubtRecord, threads: int = 1) -> None:
        self.record, self._session = record, open_session(model, threads)

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> UncertaintyEstimate:
        arrays = (np.ascontiguousarray(array, np.float32) for array in (depth_m, intensity, image))
        return UncertaintyEstimate(*self._session.run(None, dict(zip(INPUTS, arrays, strict=True))))


def load_uncertainty_model(folder: Path | None, cache: Path) -> UncertaintyModel | None:
    """Load the uncertainty network beside the weights in a folder (None: the shipped ones); None where there is none.

    The ONNX file is exported once into the folder `cache`. Raises CheckpointError as `load_doubt` does.
    """
    if (loaded := load_doubt(folder or shipped_folder())) is None:
        return None
    network, record = loaded
    model = cache / f"doubt-{checksum_of(network)}.onnx"
    if not model.exists():
        write_onnx(network, model, INPUTS, list(UncertaintyEstimate._fields))
    return OnnxUncertaintyModel(model, record)
