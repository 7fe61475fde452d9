"""A training recipe: everything that decides a run, in one short TOML file; deviations from the paper say why.

How the learning rate falls over a run, and where its fall ends the run.
"""

import tomllib
from pathlib import Path
from typing import Any, Literal, Self

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nlos_models.errors import RecipeError

MapKind = Literal["raw maps", "difference maps"]
ImageLoss = Literal["squared", "absolute"]
SIMULATION_ONLY = "simulation only: the L515's laser is infrared (860 nm)"
"""What all that is in colour says of itself."""


class Recipe(BaseModel):
    """One training run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: Literal["vae", "compressor", "transfer", "doubt"]
    colour: bool = False
    """RGB albedo in the place of depth, in simulation only."""
    seed: int = Field(default=0, ge=0)
    objects: int = Field(gt=0)
    """Training objects: for a VAE by seeds 0, 1, ..., else the first of a dataset's; held-out ones are others."""
    held_out: int = Field(gt=0)
    epochs: int = Field(gt=0)
    """At most; of a transfer, those of the classifier alone."""
    batch: int = Field(gt=1)
    """Over all processes."""
    learning_rate: float = Field(gt=1e-8)
    """Above the rate at which a plateau's run ends (SI 3 and 4)."""
    betas: tuple[float, float] = (0.5, 0.999)
    schedule: Literal["one-cycle", "plateau"] = "plateau"
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    kl_weight: float = 0.05
    latent_warm_up: float = Field(default=0.0, ge=0, le=0.5)
    """Of a VAE: for this share of the run it is a plain autoencoder; noise and divergence then rise over as much."""
    left_noise: float = 0.2
    dropout: float = Field(default=0.5, ge=0, lt=1)
    width: float = Field(default=1.0, gt=0, le=2)
    """Of a compressor's layers, as a share of Table S2's channels."""
    latent_weight: float = Field(default=1.0, ge=0)
    image_weight: float = Field(default=0.0, ge=0)
    surface_weight: float = Field(default=1.0, ge=1)
    """How much a pixel of surface counts in an image's error beside one of background (`losses.image_error`)."""
    image_loss: ImageLoss = "squared"
    """What an image's error is the sum of: the mean of what could be there answers the one, its median the other."""
    augmentation: Literal["mirror", "turns"] = "mirror"
    """About y = 0, the one symmetry that the rig has; or, for a VAE alone, by quarters of a turn too (SI 3)."""
    left_out: list[str] = Field(default_factory=list[str])
    """Categories of objects that a VAE is not shown; a dataset's own plan says which a compressor is."""
    backgrounds: float = Field(default=0.0, ge=0, le=1)
    """Of a VAE's objects: the share that has a post or a panel beside it."""
    start: Literal["scratch", "weights"] = "scratch"
    """Of a VAE or a compressor: random weights, or those of an earlier run (--weights)."""
    keep: Literal["last", "best"] = "last"
    """Which epoch's weights are handed on; the best has the least held-out loss."""
    steps: Literal["two", "one", "two-then-joint"] = "two"
    """A compressor onto a VAE's latent; or one and a decoder from scratch; or both together, from two-step weights."""
    maps: MapKind = "raw maps"
    """What the compressor eats; difference maps are the maps less the bare wall's."""
    all_layers_epochs: int = Field(default=4, ge=0)
    """Of a transfer: its first phase (SI 4: 3 to 5); `keep` says which of its epochs the second one sets out from."""
    statistics: Literal["kept", "own", "own intensity"] = "kept"
    """Of a transfer: maps are normalised as the synthetic ones were, or (their intensity alone) by the recordings' own
    mean and spread."""
    outliers: int = Field(default=0, ge=0)
    """Of a doubt network, beside the objects: of each kind that is unlike them, so many."""
    empties: int = Field(default=0, ge=0)
    """Of a doubt network: views of benches with nothing hidden."""
    deviations: list[str] = Field(default_factory=list[str])
    """Where this recipe leaves the supporting information, and why."""

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Self:
        if self.batch > self.objects:
            raise ValueError(f"a batch of {self.batch} is larger than objects ({self.objects})")
        if self.task != "vae" and not self.latent_weight + self.image_weight:
            raise ValueError("latent_weight and image_weight are both 0: there is nothing to learn by")
        if self.steps == "one" and self.latent_weight:
            raise ValueError("steps 'one' knows no latent to aim at: set latent_weight = 0")
        if self.colour and (self.task == "transfer" or self.maps != "raw maps"):
            raise ValueError("colour is simulation only, and of raw maps: no bench to transfer to, no difference maps")
        if self.steps != "two" and not self.image_weight:
            raise ValueError(
                f"steps {self.steps!r} trains a decoder, which learns by images alone: set an image_weight"
            )
        return self

    @model_validator(mode="after")
    def _asks_for_what_its_task_has(self) -> Self:
        if self.augmentation == "turns" and self.task != "vae":
            raise ValueError("augmentation 'turns' is for a VAE: maps of the rig have the mirror's symmetry alone")
        if self.latent_warm_up and self.task != "vae":
            raise ValueError("latent_warm_up is of a VAE's noise and divergence: leave it out")
        if self.task == "transfer" and self.steps != "two":
            raise ValueError(f"steps {self.steps!r} is for a compressor: a transfer keeps the decoder")
        if self.start == "weights" and (self.task == "transfer" or self.steps != "two"):
            raise ValueError("start 'weights' is for a VAE or a two-step compressor: leave it out")
        if self.width != 1 and (self.colour or self.task != "compressor"):
            raise ValueError("width is of a compressor of depth: leave it out")
        return self

    @model_validator(mode="after")
    def _doubts_by_what_it_needs(self) -> Self:
        if (self.outliers > 0, self.empties > 0) != ((self.task == "doubt"),) * 2:
            raise ValueError("a doubt network learns by outliers and empties, and no other does: set both, or none")
        return self

    def scaled(self, share: float) -> Self:
        """The same at a share of its budget (objects x epochs): fewer epochs, and fewer objects where one is too many.

        Raises RecipeError where the share is not above 0 and at most 1.
        """
        if not 0 < share <= 1:
            raise RecipeError(f"a budget of {share:g} is none: choose a share above 0 and at most 1")
        epochs = max(1, round(self.epochs * share))
        objects = max(self.batch, round(self.objects * min(1.0, self.epochs * share / epochs)))
        why = f"{share:g} of the budget: {epochs} epochs of {objects} objects, not {self.epochs} of {self.objects}"
        deviations = [*self.deviations, why] if share < 1 else self.deviations
        return self.model_copy(update={"epochs": epochs, "objects": objects, "deviations": deviations})

    def of_objects(self, objects: int) -> Self:
        """The same on another number of objects; a batch is never larger than that. RecipeError below two."""
        if objects < 2:
            raise RecipeError(f"{objects} objects are too few to train on: give at least 2")
        return self.model_copy(update={"objects": objects, "batch": min(self.batch, objects)})


def load_recipe(path: Path) -> Recipe:
    """A recipe from TOML. Raises RecipeError with the first problem."""
    try:
        return Recipe.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part) for part in problem["loc"])
        value = f" (got {problem['input']!r:.80})" if field else ""
        raise RecipeError(": ".join(part for part in (str(path), field, problem["msg"]) if part) + value) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecipeError(f"{path} cannot be read as a recipe: {error}") from error


PLATEAU_FACTOR, PLATEAU_PATIENCE, SMALLEST_RATE = 0.3, 5, 1e-8
"""SI 3 and 4: the learning rate falls by this factor after this many epochs without progress, and ends the run."""
WARM_UP = 0.15
"""Of a one-cycle run: the share in which the rate rises."""


def schedule_of(recipe: Recipe, optimizer: torch.optim.Optimizer, steps: int) -> Any:
    """The recipe's schedule over so many steps: one-cycle is stepped at each, plateau at each epoch."""
    if recipe.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer, recipe.learning_rate, total_steps=steps, pct_start=WARM_UP, cycle_momentum=False
        )
    return torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimizer,
        factor=PLATEAU_FACTOR,
        patience=PLATEAU_PATIENCE,
        eps=0.0,  # torch's own would keep a rate of 1.4e-8 for ever, and the run with it
    )


def has_ended(recipe: Recipe, rate: float) -> bool:
    """Whether a plateau's rate is so small that the run is over; one-cycle ends with its last step."""
    return recipe.schedule == "plateau" and rate < SMALLEST_RATE
