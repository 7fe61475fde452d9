"""Checkpoints: tensors in float16 safetensors, one file per network, beside one JSON record of what made them."""

import json
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from nlos_models.colour import colour_pipeline, colour_vae
from nlos_models.compressor import Compressor
from nlos_models.errors import CheckpointError
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import Recipe
from nlos_models.res_vae import Decoder, ResVae

RECORD = "checkpoint.json"
SHIPPED = "paper-rig"


class CheckpointRecord(BaseModel):
    """What the tensors cannot say."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig_name: str
    rig_checksum: str
    input: Literal["raw maps", "difference maps"] = "raw maps"
    """What the compressor eats; difference maps are the maps less the bare wall's."""
    vae_recipe: Recipe
    compressor_recipe: Recipe | None = None
    """None for a VAE alone."""
    figures: dict[str, float] = {}
    """Held-out figures at the end of training."""

    @property
    def colour(self) -> bool:
        """Whether these are weights of full colour, which is simulation only."""
        return any(recipe is not None and recipe.colour for recipe in (self.vae_recipe, self.compressor_recipe))


def save_vae(folder: Path, vae: ResVae, record: CheckpointRecord) -> None:
    """Write encoder and decoder, with their record, into a folder."""
    _save(folder, {"encoder": vae.encoder, "decoder": vae.decoder}, record)


def save_pipeline(folder: Path, pipeline: Pipeline, record: CheckpointRecord) -> None:
    """Write compressor, decoder and the preprocessing's statistics, with their record, into a folder."""
    names = ("compressor", "preprocess", "decoder")
    _save(folder, {name: getattr(pipeline, name) for name in names}, record)


def load_vae(folder: Path) -> tuple[ResVae, CheckpointRecord]:
    """A Res-VAE in eval mode. Raises CheckpointError where a tensor is missing, left over or of another shape."""
    record = load_record(folder)
    vae = colour_vae() if record.colour else ResVae()
    for name, module in (("encoder", vae.encoder), ("decoder", vae.decoder)):
        _load(folder / f"{name}.safetensors", module)
    return vae.eval(), record


def load_pipeline(folder: Path | None = None) -> tuple[Pipeline, CheckpointRecord]:
    """Compressor and decoder in eval mode, from a folder or as shipped. Raises CheckpointError as `load_vae` does."""
    folder = folder or shipped_folder()
    record = load_record(folder)
    pipeline = colour_pipeline() if record.colour else Pipeline(Compressor(), Decoder())
    for name in ("compressor", "preprocess", "decoder"):
        _load(folder / f"{name}.safetensors", getattr(pipeline, name))
    return pipeline.eval(), record


def shipped_folder() -> Path:
    """Where the weights that come with the package lie."""
    return Path(str(resources.files("nlos_models") / "weights" / SHIPPED))


def load_record(folder: Path) -> CheckpointRecord:
    """The record of a checkpoint folder."""
    try:
        return CheckpointRecord.model_validate_json((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(
            f"no checkpoint in {folder}: {RECORD} cannot be read; train one, or name another"
        ) from error
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part) for part in problem["loc"])
        raise CheckpointError(f"{folder / RECORD} is not a checkpoint's record: {field}: {problem['msg']}") from error


def _save(folder: Path, parts: dict[str, nn.Module], record: CheckpointRecord) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, module in parts.items():
        save_file(
            {key: _half(key, tensor) for key, tensor in module.state_dict().items()}, folder / f"{name}.safetensors"
        )
    text = json.dumps(record.model_dump(mode="json"), indent=2)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


def _half(name: str, tensor: torch.Tensor) -> torch.Tensor:
    if not tensor.is_floating_point() or "running" in name or name in {"mean", "spread"}:
        return tensor.contiguous()  # statistics are few, and float16 would flush the smallest to zero
    half = tensor.half().contiguous()
    if not torch.isfinite(half).all():
        raise CheckpointError(f"{name} does not fit into float16 (largest {tensor.abs().max():.3g}): training diverged")
    return half


def _load(path: Path, module: nn.Module) -> None:
    try:
        tensors: dict[str, Any] = load_file(path)
        module.load_state_dict(
            {key: value.float() if value.is_floating_point() else value for key, value in tensors.items()}
        )
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read as weights: {error}") from error
    except RuntimeError as error:
        raise CheckpointError(f"{path} does not fit this network: {str(error).splitlines()[-1].strip()}") from error
