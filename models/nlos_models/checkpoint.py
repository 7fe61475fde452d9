"""Checkpoints: one float16 safetensors file per network, beside a JSON record of runs, rig and held-out figures."""

import json
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import NamedTuple, Self

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from nlos_models.errors import CheckpointError
from nlos_models.pipeline import RemappingNetwork, new_pipeline, new_vae
from nlos_models.recipe import SIMULATION_ONLY, MapKind, Recipe
from nlos_models.vae import Encoder, ResVae


class CheckpointRecord(BaseModel):
    """Origin of a checkpoint's tensors: rig, kind of maps, recipes of the runs, and held-out figures."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig_name: str
    rig_checksum: str
    input: MapKind = "raw maps"
    """The compressor's input; difference maps are maps minus the bare wall's."""
    vae_recipe: Recipe | None = None
    """None for a compressor and decoder trained in one step."""
    compressor_recipe: Recipe | None = None
    """None for a VAE alone."""
    transfer_recipe: Recipe | None = None
    """None for weights trained on synthetic maps alone."""
    earlier: list[Recipe] = []
    """Recipes of the runs before those above, the oldest first."""
    figures: dict[str, float] = {}
    """Held-out figures at the end of training."""
    note: str = Field(default="", validate_default=True)
    """SIMULATION_ONLY for color weights, else empty, whatever value is passed in."""

    @field_validator("note")
    @classmethod
    def _note_color(cls, note: str, info: ValidationInfo) -> str:
        del note
        return SIMULATION_ONLY if _any_in_color(info.data.get("vae_recipe"), info.data.get("compressor_recipe")) else ""

    @classmethod
    def of(cls, runs: Iterable[Recipe], rig: tuple[str, str], maps: MapKind = "raw maps") -> Self:
        """Return the record of the weights that these runs made, the oldest first; `rig` is its (name, checksum)."""
        last, earlier = dict[str, Recipe](), list[Recipe]()
        for recipe in runs:
            replaced = ("compressor", "transfer") if recipe.task == "compressor" else (recipe.task,)
            earlier += [last.pop(task) for task in replaced if task in last]
            last[recipe.task] = recipe
        recipes = {f"{task}_recipe": recipe for task, recipe in last.items()}
        return cls.model_validate(
            {"rig_name": rig[0], "rig_checksum": rig[1], "input": maps, "earlier": earlier} | recipes
        )

    @property
    def runs(self) -> list[Recipe]:
        """Recipes of all runs behind these weights, the oldest first."""
        own = (self.vae_recipe, self.compressor_recipe, self.transfer_recipe)
        return [*self.earlier, *(recipe for recipe in own if recipe)]

    @property
    def vae_runs(self) -> list[Recipe]:
        """Recipes of the runs that trained the encoder or decoder."""
        return [recipe for recipe in self.runs if recipe.task == "vae" or recipe.steps == "two-then-joint"]

    @property
    def width(self) -> float:
        """Channels of the compressor's layers as a share of Table S2's."""
        return self.compressor_recipe.width if self.compressor_recipe else 1.0

    @property
    def color(self) -> bool:
        """True for weights of full color, which is simulation only."""
        return _any_in_color(self.vae_recipe, self.compressor_recipe)


def _any_in_color(*recipes: Recipe | None) -> bool:
    return any(recipe is not None and recipe.colour for recipe in recipes)


RECORD = "checkpoint.json"
SHIPPED = "paper-rig"
PIPELINE_PARTS = "compressor", "preprocess", "decoder"
FULL = frozenset({"mean", "spread", "bare_depth_m", "bare_intensity"})
"""Tensors that stay in float32."""


class LoadReport(NamedTuple):
    """Names of the tensors that a file and a network share or not; the network keeps its own where they do not fit."""

    loaded: list[str]
    missing: list[str]
    """Only in the network."""
    left_over: list[str]
    """Only in the file."""
    misshapen: list[str]
    """In both, with different shapes."""

    def __str__(self) -> str:
        rest = {name: names for name, names in self._asdict().items() if name != "loaded" and names}
        counts = [f"{len(names)} {name.replace('_', ' ')} ({', '.join(names[:3])})" for name, names in rest.items()]
        return f"{len(self.loaded)} tensors loaded; " + (", ".join(counts) or "all fit")


def save_vae(folder: Path, vae: ResVae, record: CheckpointRecord) -> None:
    """Write encoder, decoder and record into a folder."""
    _save(folder, {"encoder": vae.encoder, "decoder": vae.decoder}, record)


def save_pipeline(
    folder: Path, pipeline: RemappingNetwork, record: CheckpointRecord, encoder: Encoder | None = None
) -> None:
    """Write compressor, preprocessing statistics, decoder and record into a folder.

    An encoder is saved with them, since its latents are the targets of further training.
    """
    parts = {name: getattr(pipeline, name) for name in PIPELINE_PARTS}
    _save(folder, {**parts, "encoder": encoder} if encoder else parts, record)


def load_vae(folder: Path) -> tuple[ResVae, CheckpointRecord]:
    """Return a Res-VAE in eval mode, with its record. Raises CheckpointError unless all tensors fit."""
    record = load_record(folder)
    vae = new_vae(color=record.color)
    for name, module in (("encoder", vae.encoder), ("decoder", vae.decoder)):
        load_part(folder / f"{name}.safetensors", module)
    return vae.eval(), record


def load_pipeline(folder: Path | None = None) -> tuple[RemappingNetwork, CheckpointRecord]:
    """Return a pipeline in eval mode (default: the shipped one), with its record. Raises CheckpointError."""
    return _load_pipeline(folder or shipped_folder(), PIPELINE_PARTS)


def load_pipeline_partly(folder: Path) -> tuple[RemappingNetwork, CheckpointRecord, LoadReport]:
    """Return a pipeline with the compressor's matching tensors, its record, and a report; the rest is random.

    Raises CheckpointError where no tensor of the compressor fits, or one of the other networks does not.
    """
    pipeline, record = _load_pipeline(folder, ("preprocess", "decoder"))
    return pipeline, record, load_fitting(folder / "compressor.safetensors", pipeline.compressor)


def _load_pipeline(folder: Path, names: tuple[str, ...]) -> tuple[RemappingNetwork, CheckpointRecord]:
    record = load_record(folder)
    if not (folder / "compressor.safetensors").exists() and (folder / "encoder.safetensors").exists():
        raise CheckpointError(f"{folder} holds a VAE without a compressor: name weights from `train compressor`")
    pipeline = new_pipeline(color=record.color, width=record.width)
    for name in names:
        load_part(folder / f"{name}.safetensors", getattr(pipeline, name))
    return pipeline.eval(), record


def load_encoder(folder: Path | None = None) -> Encoder | None:
    """Return the encoder beside a pipeline's weights, in eval mode, or None where they were trained without one."""
    folder = folder or shipped_folder()
    path = folder / "encoder.safetensors"
    if not path.exists():
        return None
    encoder = new_vae(color=load_record(folder).color).encoder
    load_part(path, encoder)
    return encoder.eval()


def load_fitting(path: Path, module: nn.Module) -> LoadReport:
    """Load the tensors that a network has in the same shape. Raises CheckpointError where there are none."""
    tensors, own = _read_tensors(path), module.state_dict()
    shared = sorted(tensors.keys() & own.keys())
    fitting = [name for name in shared if tensors[name].shape == own[name].shape]
    if not fitting:
        raise CheckpointError(f"{path} holds no tensor that fits this network: name other weights")
    module.load_state_dict({name: tensors[name] for name in fitting}, strict=False)
    missing, left_over = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    return LoadReport(fitting, missing, left_over, sorted(set(shared) - set(fitting)))


def shipped_folder() -> Path:
    """Return the folder of the weights that come with the package."""
    return Path(str(resources.files("nlos_models") / "weights" / SHIPPED))


def load_record(folder: Path) -> CheckpointRecord:
    """Return the record of a checkpoint folder. Raises CheckpointError where it is missing or not a record."""
    try:
        return CheckpointRecord.model_validate_json((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(
            f"no checkpoint in {folder} ({RECORD} cannot be read): name a folder of weights"
        ) from error
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part) for part in problem["loc"])
        raise CheckpointError(f"{folder / RECORD} is not a checkpoint's record: {field}: {problem['msg']}") from error


def _save(folder: Path, parts: dict[str, nn.Module], record: CheckpointRecord) -> None:
    without = None if record.note else {"note"}  # older readers refuse the field
    text = json.dumps(record.model_dump(mode="json", exclude=without), indent=2)
    save_parts(folder, parts, {RECORD: text})


def save_parts(folder: Path, parts: Mapping[str, nn.Module], texts: Mapping[str, str]) -> None:
    """Write networks as NAME.safetensors, and texts by file name, into a folder. Raises CheckpointError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, module in parts.items():
            tensors = {key: _to_half(key, tensor) for key, tensor in module.state_dict().items()}
            save_file(tensors, folder / f"{name}.safetensors")
        for name, text in texts.items():
            (folder / name).write_text(text + "\n", encoding="utf-8")
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"cannot write weights to {folder} ({error}): free some space and run again") from error


def _to_half(name: str, tensor: torch.Tensor) -> torch.Tensor:
    if not tensor.is_floating_point() or "running" in name or name in FULL:
        return tensor.contiguous()  # statistics are few, and float16 would flush the smallest to zero
    half = tensor.half().contiguous()
    if not torch.isfinite(half).all():
        raise CheckpointError(f"{name} does not fit into float16 (largest {tensor.abs().max():.3g}): training diverged")
    return half


def load_part(path: Path, module: nn.Module) -> None:
    """Load a network strictly. Raises CheckpointError where a tensor is missing, left over or of another shape."""
    tensors = _read_tensors(path)
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(f"{path} does not fit this network: {str(error).splitlines()[-1].strip()}") from error


def _read_tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read as weights: {error}") from error
    return {key: value.float() if value.is_floating_point() else value for key, value in tensors.items()}
