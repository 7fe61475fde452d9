"""Checkpoints: one float16 safetensors file per network, beside a JSON record of runs, rig and
held-out figures.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import nn

from nlos_cam.files import TENSOR_LIMIT, describe, read_checked, write_checked
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError
from nlos_models.pipeline import RemappingNetwork, new_pipeline, new_vae
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
from nlos_models.vae import Encoder, ResVae

PIPELINE_PARTS = "compressor", "preprocess", "decoder"
FULL = frozenset({"mean", "median", "spread", "bare_depth_m", "bare_intensity"})
"""Tensors that stay in float32."""


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
    parts = {name: getattr(pipeline, name) for name in PIPELINE_PARTS}
    _save(folder, {**parts, "encoder": encoder} if encoder else parts, record)


def save_direct(folder: Path, network: DirectNetwork, record: CheckpointRecord) -> None:
    """Write a direct network and its record into a folder."""
    _save(folder, {DIRECT: network}, record)


def load_network(
    folder: Path | None = None,
) -> tuple[RemappingNetwork | DirectNetwork, CheckpointRecord]:
    """Return the network from maps to images in a folder (default: the direct one), in eval mode,
    with its record.

    Raises CheckpointError.
    """
    folder = weights_folder(folder)
    record = load_record(folder)
    if not record.direct_recipe:
        return load_pipeline(folder)
    network = DirectNetwork(record.direct_recipe.direct, color=record.color)
    load_part(folder / f"{DIRECT}.safetensors", network)
    return network.eval(), record


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
    vae = new_vae(color=record.color)
    for name, module in (("encoder", vae.encoder), ("decoder", vae.decoder)):
        load_part(folder / f"{name}.safetensors", module)
    return vae.eval(), record


def load_pipeline(folder: Path | None = None) -> tuple[RemappingNetwork, CheckpointRecord]:
    """Return a pipeline in eval mode (default: the paper's), with its record. Raises
    CheckpointError.
    """
    return _load_pipeline(weights_folder(folder, PAPER), PIPELINE_PARTS)


def load_pipeline_partly(folder: Path) -> tuple[RemappingNetwork, CheckpointRecord, LoadReport]:
    """Return a pipeline with the compressor's matching tensors, its record, and a report; the rest
    is random.

    Raises CheckpointError where no tensor of the compressor fits, or one of the other networks does
    not.
    """
    pipeline, record = _load_pipeline(folder, ("preprocess", "decoder"))
    return pipeline, record, load_fitting(folder / "compressor.safetensors", pipeline.compressor)


def _load_pipeline(
    folder: Path, names: tuple[str, ...]
) -> tuple[RemappingNetwork, CheckpointRecord]:
    record = load_record(folder)
    if record.direct_recipe:
        raise CheckpointError(
            f"{folder} holds a direct network: name weights from `train compressor`"
        )
    if not (folder / "compressor.safetensors").exists() and (folder / ENCODER).exists():
        raise CheckpointError(
            f"{folder} holds a VAE without a compressor: name weights from `train compressor`"
        )
    pipeline = new_pipeline(color=record.color, width=record.width)
    for name in names:
        load_part(folder / f"{name}.safetensors", getattr(pipeline, name))
    return pipeline.eval(), record


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


def load_fitting(path: Path, module: nn.Module) -> LoadReport:
    """Load the tensors that a network has in the same shape. Raises CheckpointError where there are
    none.
    """
    tensors = _read_tensors(path)
    own = module.state_dict()
    shared = sorted(tensors.keys() & own.keys())
    fitting = [name for name in shared if tensors[name].shape == own[name].shape]
    if not fitting:
        raise CheckpointError(f"{path} holds no tensor that fits this network: name other weights")
    module.load_state_dict({name: tensors[name] for name in fitting}, strict=False)
    missing = sorted(own.keys() - tensors.keys())
    left_over = sorted(tensors.keys() - own.keys())
    return LoadReport(fitting, missing, left_over, sorted(set(shared) - set(fitting)))


def _save(folder: Path, parts: dict[str, nn.Module], record: CheckpointRecord) -> None:
    unset = {
        name for name in ("note", "direct_recipe") if not getattr(record, name)
    }  # older readers refuse these
    text = json.dumps(record.model_dump(mode="json", exclude=unset), indent=2)
    save_parts(folder, parts, {RECORD: text})


def save_parts(folder: Path, parts: Mapping[str, nn.Module], texts: Mapping[str, str]) -> None:
    """Write networks as NAME.safetensors, texts by file name, and checksums of all into a folder.

    Raises CheckpointError.
    """
    files = {f"{name}.safetensors": _pack(module) for name, module in parts.items()}
    try:
        write_checked(folder, files | {name: f"{text}\n".encode() for name, text in texts.items()})
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"cannot write weights to {folder} ({error}): free some space and run again"
        ) from error


def _pack(module: nn.Module) -> bytes:
    return save({name: _to_half(name, tensor) for name, tensor in module.state_dict().items()})


def _to_half(name: str, tensor: torch.Tensor) -> torch.Tensor:
    if not tensor.is_floating_point() or "running" in name or name.rpartition(".")[2] in FULL:
        return (
            tensor.contiguous()
        )  # statistics are few, and float16 would flush the smallest to zero
    half = tensor.half().contiguous()
    if not torch.isfinite(half).all():
        raise CheckpointError(
            f"{name} does not fit into float16 (largest {tensor.abs().max():.3g}): training"
            " diverged"
        )
    return half


def load_part(path: Path, module: nn.Module) -> None:
    """Load a network strictly. Raises CheckpointError where a tensor is missing, left over or of
    another shape.
    """
    tensors = _read_tensors(path)
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(
            f"{path} does not fit this network: {str(error).splitlines()[-1].strip()}"
        ) from error


def _read_tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        tensors = load(read_checked(path, TENSOR_LIMIT))
    except (OSError, ValueError, SafetensorError, MemoryError) as error:
        raise CheckpointError(f"{path} cannot be read as weights: {describe(error)}") from error
    floats = {
        key: value.float() if value.is_floating_point() else value for key, value in tensors.items()
    }
    if bad := [key for key, value in floats.items() if not torch.isfinite(value).all()]:
        raise CheckpointError(
            f"{path} cannot be used as weights: {bad[0]} is not finite; train or copy them again"
        )
    return floats
