"""A doubt network's files, beside the weights that it watches: tensors, and a record that names those by checksum.

Doubt at run time: a doubt network exported to ONNX and run by ONNX Runtime on one thread of a CPU.
"""

import hashlib
import json
import shutil
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nlos_models.arrays import Float32
from nlos_models.checkpoint import RECORD, load_part, save_parts, shipped_folder
from nlos_models.doubt_network import MAP_SHAPE, DoubtNetwork, Told
from nlos_models.errors import CheckpointError
from nlos_models.inference import checksum_of, open_session, write_onnx
from nlos_models.recipe import Recipe

DOUBT, DOUBT_RECORD = "doubt", "doubt.json"
WATCHED = "compressor.safetensors", "preprocess.safetensors", "decoder.safetensors"


class DoubtRecord(BaseModel):
    """What the tensors cannot say."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    watches: str
    """Of the weights whose images it judges, `checksum_of_watched`."""
    recipe: Recipe
    learnt: list[str]
    """The kinds of outliers that it was shown."""
    temperatures: tuple[float, float] = (1.0, 1.0)
    """What the logits of nothing and of outside are divided by."""
    error_scale: float = Field(default=1.0, gt=0)
    """What the expected error is multiplied by."""
    nothing_above: float = Field(default=0.5, ge=0, le=1)
    """The probability from which on nothing is told to be there."""
    outside_above: float = Field(default=0.5, ge=0, le=1)
    """The probability from which on what is there is told to be outside the trained range."""
    figures: dict[str, float] = {}
    """Held-out figures at the end of training, and of the calibration."""


def checksum_of_watched(folder: Path) -> str:
    """Twelve hexadecimal digits that change with any tensor of a pipeline's weights. Raises CheckpointError."""
    digest = hashlib.sha256()
    for name in WATCHED:
        try:
            digest.update((folder / name).read_bytes())
        except OSError as error:
            raise CheckpointError(f"{folder / name} cannot be read: name a folder of a compressor's weights") from error
    return digest.hexdigest()[:12]


def save_doubt(folder: Path, network: DoubtNetwork, record: DoubtRecord, watched: Path) -> None:
    """Write a doubt network into a folder, with a copy of the weights that it watches unless that is their folder."""
    if checksum_of_watched(watched) != record.watches:
        raise CheckpointError(f"{watched} changed while its doubt was trained: train again")
    text = json.dumps(record.model_dump(mode="json"), indent=2)
    save_parts(folder, {DOUBT: network}, {DOUBT_RECORD: text})
    if folder.resolve() != watched.resolve():
        for name in (*WATCHED, RECORD):
            shutil.copyfile(watched / name, folder / name)


def load_doubt(folder: Path) -> tuple[Told, DoubtRecord] | None:
    """The doubt network beside a pipeline's weights, calibrated and in eval mode; None where there is none.

    Raises CheckpointError where it cannot be read, or was trained to watch other weights.
    """
    if not (folder / DOUBT_RECORD).exists():
        return None
    record = _record(folder / DOUBT_RECORD)
    if record.watches != (found := checksum_of_watched(folder)):
        raise CheckpointError(
            f"{folder / DOUBT_RECORD} is of other weights ({record.watches}) than those beside it ({found}): train it "
            "again with `train doubt`, or take it away"
        )
    network = DoubtNetwork()
    load_part(folder / f"{DOUBT}.safetensors", network)
    return Told(network, record.temperatures, record.error_scale).eval(), record


def _record(path: Path) -> DoubtRecord:
    try:
        return DoubtRecord.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} cannot be read: train it again with `train doubt`") from error
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part) for part in problem["loc"])
        raise CheckpointError(f"{path} is not a doubt network's record: {field}: {problem['msg']}") from error


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


class UncertaintyModel(Protocol):
    """A doubt network, ready to run."""

    record: DoubtRecord

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> SaidOf:
        """Maps (n, 64, 80), NaN depth where there is no return, and the images (n, 64, 64) made of them."""
        ...


class OnnxUncertaintyModel:
    """A doubt network as ONNX Runtime runs it."""

    def __init__(self, model: Path, record: DoubtRecord, threads: int = 1) -> None:
        self.record, self._session = record, open_session(model, threads)

    def __call__(self, depth_m: Float32, intensity: Float32, image: Float32) -> SaidOf:
        arrays = (np.ascontiguousarray(array, np.float32) for array in (depth_m, intensity, image))
        return SaidOf(*self._session.run(None, dict(zip(INPUTS, arrays, strict=True))))


def load_uncertainty_model(folder: Path | None, cache: Path) -> UncertaintyModel | None:
    """The doubt network beside the shipped weights (None), or beside those of a folder; None where there is none.

    The ONNX file is exported once into the folder `cache`. Raises CheckpointError as `load_doubt` does.
    """
    if (found := load_doubt(folder or shipped_folder())) is None:
        return None
    network, record = found
    model = cache / f"doubt-{checksum_of(network)}.onnx"
    if not model.exists():
        write_onnx(network, model, INPUTS, list(SaidOf._fields))
    return OnnxUncertaintyModel(model, record)
