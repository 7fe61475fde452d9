"""Checkpoints of training runs: weights to save, and networks that only training starts from."""

import json
import shutil
from pathlib import Path
from typing import NamedTuple

from torch import nn

from nlos_cam.files import CHECKSUMS, atomic_file
from nlos_models.checkpoint import (
    PIPELINE_PARTS,
    load_part,
    load_pipeline_parts,
    read_tensors,
    save_parts,
)
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError
from nlos_models.pipeline import RemappingNetwork, new_vae
from nlos_models.records import (
    DIRECT,
    ENCODER,
    PAPER,
    RECORD,
    CheckpointRecord,
    load_record,
    shipped_folder,
    weights_folder,
)
from nlos_models.training.run_files import FINISHED
from nlos_models.vae import Encoder, ResVae

WEIGHT_SUFFIXES = ".safetensors", ".onnx", ".json"


class LoadReport(NamedTuple):
    """Names of the tensors that a file and a network share or not; the network keeps its own where
    they do not fit.
    """

    loaded: list[str]
    missing: list[str]
    """Only in the network."""
    left_over: list[str]
    """Only in the file."""
    misshapen: list[str]
    """In both, with different shapes."""

    def __str__(self) -> str:
        rest = {name: names for name, names in self._asdict().items() if name != "loaded" and names}
        counts = [
            f"{len(names)} {name.replace('_', ' ')} ({', '.join(names[:3])})"
            for name, names in rest.items()
        ]
        return f"{len(self.loaded)} tensors loaded; " + (", ".join(counts) or "all fit")


def save_vae(folder: Path, vae: ResVae, record: CheckpointRecord) -> None:
    """Write encoder, decoder and record into a folder."""
    _save(folder, {"encoder": vae.encoder, "decoder": vae.decoder}, record)


def save_pipeline(
    folder: Path,
    pipeline: RemappingNetwork,
    record: CheckpointRecord,
    encoder: Encoder | None = None,
) -> None:
    """Write compressor, preprocessing statistics, decoder and record into a folder.

    An encoder is saved with them, since its latents are the targets of further training.
    """
    # The statistics of the preprocessing are weights like others: with another bench's, all maps
    # are shifted.
    parts = {name: getattr(pipeline, name) for name in PIPELINE_PARTS}
    _save(folder, {**parts, "encoder": encoder} if encoder else parts, record)


def save_direct(folder: Path, network: DirectNetwork, record: CheckpointRecord) -> None:
    """Write a direct network and its record into a folder."""
    _save(folder, {DIRECT: network}, record)


def _save(folder: Path, parts: dict[str, nn.Module], record: CheckpointRecord) -> None:
    # Readers of earlier versions refuse fields that they do not know, so that unset ones are not
    # written.
    optional = "note", "direct_recipe", "program", "bare_wall_counts"
    unset = {name for name in optional if not getattr(record, name)}
    text = json.dumps(record.model_dump(mode="json", exclude=unset), indent=2)
    save_parts(folder, parts, {RECORD: text})


def copy_weights(folder: Path, target: Path) -> None:
    """Copy weights with their record, graphs, uncertainty network and checksums into a folder.
    Raises CheckpointError.
    """
    target.mkdir(parents=True, exist_ok=True)
    try:
        for path in sorted(folder.iterdir()):
            # The run that ended in `folder` is not that of `target`.
            is_weights = path.suffix in WEIGHT_SUFFIXES and path.name != FINISHED
            if is_weights or path.name == CHECKSUMS:
                with atomic_file(target / path.name) as part:
                    shutil.copyfile(path, part)
    except OSError as error:
        raise CheckpointError(
            f"{folder} cannot be copied to {target} ({error.strerror}): free some space and run"
            " again"
        ) from error


def load_vae(folder: Path | None = None) -> tuple[ResVae, CheckpointRecord]:
    """Return a Res-VAE (default: the paper's) in eval mode, with its record. Raises
    CheckpointError.
    """
    folder = weights_folder(folder, PAPER)
    record = load_record(folder)
    if not (folder / ENCODER).exists() and folder == shipped_folder(PAPER):
        raise CheckpointError(
            "the paper's weights come without their encoder (21 MB), which only training needs:"
            " make it again with `nlos-cam train vae --recipe vae-encoder --out DIR`, and give"
            " --vae DIR"
        )
    # One file a network: the decoder of a pipeline is also that of its VAE.
    vae = new_vae(color=record.color)
    for name, module in (("encoder", vae.encoder), ("decoder", vae.decoder)):
        load_part(folder / f"{name}.safetensors", module)
    return vae.eval(), record


def load_encoder(folder: Path | None = None) -> Encoder | None:
    """Return the encoder beside a pipeline's weights (default: the paper's), in eval mode, or None
    without one.
    """
    folder = weights_folder(folder, PAPER)
    path = folder / ENCODER
    if not path.exists():
        return None
    encoder = new_vae(color=load_record(folder).color).encoder
    load_part(path, encoder)
    return encoder.eval()


def load_pipeline_partly(folder: Path) -> tuple[RemappingNetwork, CheckpointRecord, LoadReport]:
    """Return a pipeline with the compressor's matching tensors, its record, and a report; the rest
    is random.

    Raises CheckpointError where no tensor of the compressor fits, or one of the other networks does
    not.
    """
    pipeline, record = load_pipeline_parts(folder, ("preprocess", "decoder"))
    return pipeline, record, load_fitting(folder / "compressor.safetensors", pipeline.compressor)


def load_fitting(path: Path, module: nn.Module) -> LoadReport:
    """Load the tensors that a network has in the same shape. Raises CheckpointError where there are
    none.
    """
    tensors = read_tensors(path)
    own = module.state_dict()
    shared = sorted(tensors.keys() & own.keys())
    fitting = [name for name in shared if tensors[name].shape == own[name].shape]
    if not fitting:
        raise CheckpointError(f"{path} holds no tensor that fits this network: name other weights")
    # Not strict, on purpose, in this one place: the caller asked for a part (`--partial`), and
    # the report says which tensors it got.
    module.load_state_dict({name: tensors[name] for name in fitting}, strict=False)
    missing = sorted(own.keys() - tensors.keys())
    left_over = sorted(tensors.keys() - own.keys())
    return LoadReport(fitting, missing, left_over, sorted(set(shared) - set(fitting)))
