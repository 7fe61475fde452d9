"""Records of checkpoints, read without torch: runs, rig and held-out figures of weights and of
uncertainty networks.
"""

import hashlib
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from nlos_cam.files import TEXT_LIMIT, read_checked
from nlos_models.errors import CheckpointError, first_problem
from nlos_models.training.recipe import (
    AnyRecipe,
    CompressorRecipe,
    DirectRecipe,
    MapKind,
    Recipe,
    TransferRecipe,
    UncertaintyRecipe,
    VaeRecipe,
)

SIMULATION_ONLY = "simulation only: the L515's laser is infrared (860 nm)"
"""Note on all data, weights and results in color."""

RECORD = "checkpoint.json"
TRAINING_LOG = "log.csv"
"""A training run's figures, a row per epoch."""
DIRECT = "direct"
PAPER = "paper"
WIDE = "wide"
ANY = "any"
RIG_WEIGHTS = DIRECT, WIDE
"""Names of the shipped weights for one rig each."""
BENCH_WEIGHTS = *RIG_WEIGHTS, ANY
"""Names of the shipped weights that benches use: those for one rig, and those for any."""
SHIPPED = *BENCH_WEIGHTS, PAPER
"""Names of the weights that come with the package, the default ones first; DIRECT.safetensors is a
direct network.
"""
ENCODER = "encoder.safetensors"
"""File that only training reads: the shipped weights come without it."""
UNCERTAINTY = "doubt"
UNCERTAINTY_RECORD = "doubt.json"
WATCHED = "compressor.safetensors", "preprocess.safetensors", "decoder.safetensors"


class CheckpointRecord(BaseModel):
    """Origin of a checkpoint's tensors: rig, kind of maps, recipes of the runs, and held-out
    figures.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig_name: str
    rig_checksum: str
    rig: dict[str, Any] | None = None
    """Fields of the rig that the weights are for: a measured one, or one that weights on the wall
    grid were trained on for. None for a packaged rig, known by its name, and for any rig."""
    bare_wall_counts: float | None = None
    """Counts of the brightest bare wall in training; None for those of the simulated sensor."""
    input: MapKind = "raw maps"
    """The compressor's input; difference maps are maps minus the bare wall's."""
    vae_recipe: VaeRecipe | None = None
    """None for a compressor and decoder trained in one step."""
    compressor_recipe: CompressorRecipe | None = None
    """None for a VAE alone."""
    transfer_recipe: TransferRecipe | None = None
    """None for weights trained on synthetic maps alone."""
    direct_recipe: DirectRecipe | None = None
    """None for anything but a direct network, which has no other networks beside it."""
    earlier: list[AnyRecipe] = []
    """Recipes of the runs before those above, the oldest first."""
    figures: dict[str, float] = {}
    """Held-out figures at the end of training."""
    program: str = ""
    """Program that trained them, with its version and commit; empty in weights before 0.2.0."""
    note: str = Field(default="", validate_default=True)
    """SIMULATION_ONLY for color weights, else empty, whatever value is passed in."""

    @field_validator("note")
    @classmethod
    def _note_color(cls, note: str, info: ValidationInfo) -> str:
        del note
        recipes = (info.data.get(f"{task}_recipe") for task in ("vae", "compressor", "direct"))
        return SIMULATION_ONLY if _any_in_color(*recipes) else ""

    @classmethod
    def of(cls, runs: Iterable[Recipe], rig: tuple[str, str], maps: MapKind = "raw maps") -> Self:
        """Return the record of the weights that these runs made, the oldest first; `rig` is its
        (name, checksum).
        """
        last = dict[str, Recipe]()
        earlier = list[Recipe]()
        # A transfer fits the network that was trained before it: where another run of that network
        # follows, both are history. A new VAE replaces the VAE alone.
        for recipe in runs:
            fitted = ("transfer",) if recipe.task in {"compressor", "direct"} else ()
            replaced = (recipe.task, *fitted)
            earlier += [last.pop(task) for task in replaced if task in last]
            last[recipe.task] = recipe
        recipes = {f"{task}_recipe": recipe for task, recipe in last.items()}
        return cls.model_validate(
            {"rig_name": rig[0], "rig_checksum": rig[1], "input": maps, "earlier": earlier}
            | recipes
        )

    @property
    def runs(self) -> list[Recipe]:
        """Recipes of all runs behind these weights, the oldest first."""
        own = (self.vae_recipe, self.compressor_recipe, self.direct_recipe, self.transfer_recipe)
        return [*self.earlier, *(recipe for recipe in own if recipe)]

    @property
    def vae_runs(self) -> list[Recipe]:
        """Recipes of the runs that trained the encoder or decoder."""
        return [recipe for recipe in self.runs if _trains_decoder(recipe)]

    @property
    def width(self) -> float:
        """Channels of the compressor's layers as a share of Table S2's."""
        return self.compressor_recipe.width if self.compressor_recipe else 1.0

    @property
    def color(self) -> bool:
        """True for weights of full color, which is simulation only."""
        return _any_in_color(self.vae_recipe, self.compressor_recipe, self.direct_recipe)


def _trains_decoder(recipe: Recipe) -> bool:
    joint = isinstance(recipe, CompressorRecipe) and recipe.steps == "two-then-joint"
    return joint or isinstance(recipe, VaeRecipe)


def _any_in_color(*recipes: Recipe | None) -> bool:
    return any(recipe is not None and recipe.colour for recipe in recipes)


def shipped_folder(name: str = DIRECT) -> Path:
    """Return the folder of weights that come with the package; `name` is one of SHIPPED."""
    return Path(str(resources.files("nlos_models") / "weights" / name))


def shipped_name(weights: Path) -> str | None:
    """Return the name of weights that come with the package, by name or folder; None for others."""
    folder = weights_folder(weights)
    return next((name for name in SHIPPED if shipped_folder(name) == folder), None)


def weights_folder(weights: Path | None, default: str = DIRECT) -> Path:
    """Return the folder of weights: the package's for None, and for a name in SHIPPED unless a
    folder has that name.
    """
    if weights is None:
        return shipped_folder(default)
    if str(weights) in SHIPPED and not weights.exists():
        return shipped_folder(str(weights))
    return weights


def load_record(folder: Path) -> CheckpointRecord:
    """Return the record of a checkpoint folder. Raises CheckpointError where it is missing or not a
    record.
    """
    try:
        return CheckpointRecord.model_validate_json(read_checked(folder / RECORD, TEXT_LIMIT))
    except OSError as error:
        raise CheckpointError(
            f"no checkpoint in {folder} ({RECORD} cannot be read): name a folder of weights"
        ) from error
    except ValidationError as error:
        raise CheckpointError(
            f"{folder / RECORD} is not a checkpoint's record: {first_problem(error)}"
        ) from error
    except ValueError as error:
        raise CheckpointError(
            f"{folder / RECORD} is {error}: copy or train the weights again"
        ) from error


Positive = Annotated[float, Field(gt=0)]


class UncertaintyRecord(BaseModel):
    """Watched weights, recipe, calibration and held-out figures of an uncertainty network."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    watches: str
    """`checksum_of_watched` of the weights whose images it judges."""
    recipe: UncertaintyRecipe
    program: str = ""
    """As in CheckpointRecord."""
    learnt: list[str]
    """Kinds of outliers in its training set."""
    temperatures: tuple[Positive, Positive] = (1.0, 1.0)
    """Divisors of the logits of nothing and of outside (out of distribution)."""
    error_scale: Positive = 1.0
    """Factor of the expected error."""
    nothing_above: float = Field(default=0.5, ge=0, le=1)
    """Lowest probability of the verdict that nothing is hidden."""
    outside_above: float = Field(default=0.5, ge=0, le=1)
    """Lowest probability of the verdict that a frame is out of distribution (outside the trained
    range).
    """
    figures: dict[str, float] = {}
    """Held-out figures at the end of training and of the calibration."""


def watched_files(folder: Path) -> tuple[str, ...]:
    """Return the names of the files with the weights that make images: of a direct network, or of a
    pipeline.
    """
    direct = f"{DIRECT}.safetensors"
    return (direct,) if (folder / direct).exists() else WATCHED


def checksum_of_watched(folder: Path, names: Sequence[str] = ()) -> str:
    """Return a checksum, 12 hexadecimal digits, of files: by default `watched_files`. Raises
    CheckpointError.
    """
    # The bytes of the files, not the tensors' values: a graph points into these bytes.
    digest = hashlib.sha256()
    for name in names or watched_files(folder):
        try:
            digest.update((folder / name).read_bytes())
        except OSError as error:
            raise CheckpointError(
                f"{folder / name} cannot be read: name a folder with a compressor's weights"
            ) from error
    return digest.hexdigest()[:12]


def load_uncertainty_record(folder: Path) -> UncertaintyRecord | None:
    """Return the record of the uncertainty network beside a pipeline's weights, or None where there
    is none.

    Raises CheckpointError where it cannot be read or watches other weights.
    """
    path = folder / UNCERTAINTY_RECORD
    if not path.exists():
        return None
    try:
        record = UncertaintyRecord.model_validate_json(read_checked(path, TEXT_LIMIT))
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be read: train it again with `train doubt`"
        ) from error
    except ValidationError as error:
        raise CheckpointError(
            f"{path} is not an uncertainty network's record: {first_problem(error)}"
        ) from error
    except ValueError as error:
        raise CheckpointError(f"{path} is {error}: train it again with `train doubt`") from error
    if record.watches != (found := checksum_of_watched(folder)):
        raise CheckpointError(
            f"{path} watches other weights ({record.watches}) than those beside it ({found}): train"
            " it again with `train doubt`, or remove it"
        )
    return record
