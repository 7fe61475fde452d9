"""Checkpoints: one safetensors file per network, in float16 or bytes, beside a JSON record of runs,
rig and held-out figures.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import nn

from nlos_cam.files import TENSOR_LIMIT, describe, read_checked, write_checked
from nlos_models.byte_weights import SCALE, from_bytes
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError
from nlos_models.pipeline import RemappingNetwork, new_pipeline
from nlos_models.records import (
    DIRECT,
    ENCODER,
    PAPER,
    CheckpointRecord,
    load_record,
    weights_folder,
)

PIPELINE_PARTS = "compressor", "preprocess", "decoder"
FULL = frozenset({"mean", "median", "spread", "bare_depth_m", "bare_intensity"})
"""Tensors that stay in float32."""


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


def load_pipeline(folder: Path | None = None) -> tuple[RemappingNetwork, CheckpointRecord]:
    """Return a pipeline in eval mode (default: the paper's), with its record. Raises
    CheckpointError.
    """
    return load_pipeline_parts(weights_folder(folder, PAPER), PIPELINE_PARTS)


def load_pipeline_parts(
    folder: Path, names: tuple[str, ...]
) -> tuple[RemappingNetwork, CheckpointRecord]:
    """Return a pipeline with some of its networks loaded, the others random."""
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
    # Half precision halves the file; its 11 bits of mantissa are 0.05 %. Above 65504 it is
    # infinite.
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
    tensors = read_tensors(path)
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(
            f"{path} does not fit this network: {str(error).splitlines()[-1].strip()}"
        ) from error


def stored_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of a file as it has them. Raises CheckpointError."""
    try:
        return load(read_checked(path, TENSOR_LIMIT))
    except (OSError, ValueError, SafetensorError, MemoryError) as error:
        raise CheckpointError(f"{path} cannot be read as weights: {describe(error)}") from error


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of a file in float32. Raises CheckpointError where one is not finite."""
    tensors = stored_tensors(path)
    # All computing is in float32: CPUs have no fast half precision, and rounding happened once,
    # when the weights were saved.
    floats = {
        key: value.float() if value.is_floating_point() else value for key, value in tensors.items()
    }
    # A weight in bytes has its scales beside it: both become one tensor, as networks know it.
    for key in [name for name in floats if name.endswith(SCALE)]:
        scale = floats.pop(key).numpy()
        name = key.removesuffix(SCALE)
        try:
            floats[name] = torch.from_numpy(from_bytes(floats[name].numpy(), scale))
        except (KeyError, ValueError) as error:
            raise CheckpointError(
                f"{path} cannot be used as weights: the scales of {name} fit no bytes ({error})"
            ) from error
    if bad := [key for key, value in floats.items() if not torch.isfinite(value).all()]:
        raise CheckpointError(
            f"{path} cannot be used as weights: {bad[0]} is not finite; train or copy them again"
        )
    return floats
