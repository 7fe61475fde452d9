"""Training recipes, each a short TOML file that defines a run with its deviations from the paper,
and schedules.
"""

import math
import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nlos_cam.files import read_toml
from nlos_models.errors import RecipeError, UnknownRecipeError, first_problem

if TYPE_CHECKING:
    import torch

MapKind = Literal["raw maps", "difference maps"]
ImageLoss = Literal["squared", "absolute"]
Precision = Literal["32-true", "bf16-mixed"]
SIMULATION_ONLY = "simulation only: the L515's laser is infrared (860 nm)"
"""Note on all data, weights and results in color."""


class DirectSize(BaseModel):
    """Widths and depths of a direct network."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    features: int = Field(default=96, gt=1, multiple_of=2)
    """Of an input token: 8 x 8 cells."""
    width: int = Field(default=384, gt=0)
    """Of each side in the trunk."""
    blocks: int = Field(default=3, ge=0)
    """Residual blocks of the trunk."""
    token: int = Field(default=128, gt=0)
    """Features of an output token: 8 x 8 pixels."""
    mixers: int = Field(default=2, ge=0)
    """Blocks that mix output tokens."""


class Recipe(BaseModel):
    """Parameters of one training run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: Literal["vae", "compressor", "transfer", "doubt", "direct"]
    colour: bool = False
    """Train on RGB albedo in place of depth, in simulation only."""
    seed: int = Field(default=0, ge=0)
    objects: int = Field(gt=0)
    """Training objects: for a VAE seeds 0, 1, ..., else the first of a dataset; held-out objects
    are different ones. For a direct network the samples of an epoch, drawn from all objects that
    are there when it begins."""
    held_out: int = Field(gt=0)
    epochs: int = Field(gt=0)
    """Upper limit; for a transfer, of its second phase."""
    batch: int = Field(gt=1)
    """Summed over all processes."""
    learning_rate: float = Field(gt=1e-8)
    """Initial rate, or one-cycle's peak; above the rate at which a plateau run ends (SI 3 and
    4).
    """
    betas: tuple[float, float] = (0.5, 0.999)
    schedule: Literal["one-cycle", "plateau", "cosine"] = "plateau"
    warm_up_steps: int = Field(default=100, ge=0)
    """Cosine schedule: steps in which the rate rises."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Decoupled, as in AdamW; 0: Adam."""
    average: float = Field(default=0.0, ge=0, lt=1)
    """Decay of the moving average of the weights, which is then what is scored and kept; 0:
    none.
    """
    gradient_limit: float = Field(default=0.0, ge=0)
    """Largest norm of the gradients, which are scaled down to it; 0: none."""
    precision: Precision = "32-true"
    """Of the products; on a CPU that emulates bfloat16, float32 takes its place
    (`distributed.precision_on`).
    """
    kl_weight: float = 0.05
    latent_warm_up: float = Field(default=0.0, ge=0, le=0.5)
    """VAE: share of the run as a plain autoencoder; noise and divergence then rise over an equal
    share.
    """
    left_noise: float = 0.2
    dropout: float = Field(default=0.5, ge=0, lt=1)
    width: float = Field(default=1.0, gt=0, le=2)
    """Channels of a compressor's layers as a share of Table S2's."""
    latent_weight: float = Field(default=1.0, ge=0)
    image_weight: float = Field(default=0.0, ge=0)
    surface_weight: float = Field(default=1.0, ge=1)
    """Weight of a surface pixel in an image's error, relative to a background pixel
    (`vae.image_error`).
    """
    noise: float = Field(default=0.0, ge=0)
    """Direct network: standard deviation of the noise added to normalised maps."""
    wall_texture: float = Field(default=0.0, ge=0, le=0.5)
    """Direct network: each sample's wall has a reflectance whose logarithm varies by up to this
    standard deviation.
    """
    range_offset_m: float = Field(default=0.0, ge=0, le=0.1)
    """Direct network: standard deviation of the range offset of each sample's lidar."""
    blend: float = Field(default=1.0, gt=0, le=1)
    """Direct network that goes on from weights: share of the trained weights in their mean with
    those it started from, which keeps what the new maps do not show (Wortsman et al. 2022, "Robust
    fine-tuning of zero-shot models")."""
    direct: DirectSize = DirectSize()
    """Size of a direct network."""
    image_loss: ImageLoss = "squared"
    """Error of a pixel; the best answer is the mean ("squared") or median ("absolute") of possible
    images.
    """
    augmentation: Literal["mirror", "turns"] = "mirror"
    """Mirror about y = 0, the rig's only symmetry; or, for a VAE, quarter turns as well (SI 3)."""
    left_out: list[str] = Field(default_factory=list[str])
    """Object categories left out of a VAE's training; for a compressor, the dataset's plan
    decides.
    """
    backgrounds: float = Field(default=0.0, ge=0, le=1)
    """Share of a VAE's objects with a post or a panel beside them."""
    start: Literal["scratch", "weights", "decoder"] = "scratch"
    """VAE, compressor or direct network: random initial weights, or those of an earlier run
    (--weights); or, for a VAE, an untrained encoder before the decoder of such weights, which stays
    as it is."""
    keep: Literal["last", "best"] = "last"
    """Epoch whose weights are saved; the best one has the smallest held-out loss."""
    steps: Literal["two", "one", "two-then-joint"] = "two"
    """Compressor onto a VAE's latent; or compressor and decoder end to end, from scratch or from
    two-step weights.
    """
    maps: MapKind = "raw maps"
    """The compressor's input; difference maps are maps minus the bare wall's."""
    all_layers_epochs: int = Field(default=4, ge=0)
    """Transfer: epochs of its first phase (SI 4: 3 to 5); the second phase starts from the epoch
    chosen by `keep`.
    """
    statistics: Literal["kept", "own", "own intensity"] = "kept"
    """Transfer: normalise all maps as the synthetic ones, or all channels (or intensity alone) by
    the recordings' own mean and spread."""
    outliers: int = Field(default=0, ge=0)
    """Uncertainty network: number of outliers of each out-of-distribution kind."""
    empties: int = Field(default=0, ge=0)
    """Uncertainty network: number of views of benches with nothing hidden."""
    deviations: list[str] = Field(default_factory=list[str])
    """Deviations from the supporting information, each with its reason."""

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if self.batch > self.objects:
            raise ValueError(f"a batch of {self.batch} is larger than objects ({self.objects})")
        if self.task not in {"vae", "direct"} and not self.latent_weight + self.image_weight:
            raise ValueError("latent_weight and image_weight are both 0: set at least one of them")
        if self.steps == "one" and self.latent_weight:
            raise ValueError("steps = 'one' has no target latent: set latent_weight = 0")
        if self.colour and (self.task == "transfer" or self.maps != "raw maps"):
            raise ValueError(
                "colour = true is simulation only and uses raw maps: no transfer, no difference"
                " maps"
            )
        if self.steps != "two" and not self.image_weight:
            raise ValueError(
                f"steps = {self.steps!r} trains a decoder, which needs an image loss: set"
                " image_weight"
            )
        return self

    @model_validator(mode="after")
    def _check_task(self) -> Self:
        if self.augmentation == "turns" and self.task != "vae":
            raise ValueError(
                "augmentation = 'turns' is for a VAE: the rig's maps have mirror symmetry only"
            )
        if self.latent_warm_up and self.task != "vae":
            raise ValueError("latent_warm_up applies to a VAE only: drop it")
        if self.task == "transfer" and self.steps != "two":
            raise ValueError(
                f"steps = {self.steps!r} is for a compressor: a transfer keeps the decoder"
            )
        if self.start == "weights" and (self.task == "transfer" or self.steps != "two"):
            raise ValueError(
                "start = 'weights' is for a VAE, a two-step compressor or a direct network: drop it"
            )
        if self.blend != 1 and (self.task, self.start) != ("direct", "weights"):
            raise ValueError("blend is for a direct network with start = 'weights': drop it")
        if self.start == "decoder" and self.task != "vae":
            raise ValueError("start = 'decoder' is for a VAE: drop it")
        if self.width != 1 and (self.colour or self.task != "compressor"):
            raise ValueError("width applies to a compressor of depth only: drop it")
        if (self.outliers > 0, self.empties > 0) != ((self.task == "doubt"),) * 2:
            raise ValueError(
                "outliers and empties are for an uncertainty network (task = 'doubt'): set both, or"
                " none"
            )
        return self

    def trains_like(self, other: Self) -> bool:
        """Return True where two recipes differ in the wording of their deviations alone."""
        return self.model_copy(update={"deviations": other.deviations}) == other

    def scaled(self, share: float) -> Self:
        """Return the recipe at a share of its budget (objects x epochs): fewer epochs, and objects
        below one epoch.

        Raises RecipeError for a share outside (0, 1].
        """
        if not 0 < share <= 1:
            raise RecipeError(f"--budget must be above 0 and at most 1, got {share:g}")
        epochs = max(1, round(self.epochs * share))
        objects = max(self.batch, round(self.objects * min(1.0, self.epochs * share / epochs)))
        why = (
            f"{share:g} of the budget: {epochs} epochs of {objects} objects, not {self.epochs} of"
            f" {self.objects}"
        )
        deviations = [*self.deviations, why] if share < 1 else self.deviations
        return self.model_copy(
            update={"epochs": epochs, "objects": objects, "deviations": deviations}
        )

    def of_objects(self, objects: int) -> Self:
        """Return the recipe for another number of objects, at most one batch of them. Raises
        RecipeError below two.
        """
        if objects < 2:
            raise RecipeError(f"{objects} objects are too few to train on: give at least 2")
        return self.model_copy(update={"objects": objects, "batch": min(self.batch, objects)})


def packaged_recipes() -> dict[str, Path]:
    """Return the recipes that come with the package (in a clone: models/recipes) by name, less
    "paper-rig-".
    """
    here = Path(__file__).parent
    folder = next(
        (folder for folder in (here / "recipes", here.parent / "recipes") if folder.is_dir()), here
    )
    return {path.stem.removeprefix("paper-rig-"): path for path in sorted(folder.glob("*.toml"))}


def load_recipe(path: Path) -> Recipe:
    """Read a recipe from TOML, or a packaged one by name. Raises RecipeError with the first
    problem.
    """
    if str(path) == path.stem and not path.exists():
        known = packaged_recipes()
        if (name := path.stem.removeprefix("paper-rig-")) not in known:
            near = "".join(
                f" Did you mean {match!r}?" for match in get_close_matches(name, known, 1)
            )
            raise UnknownRecipeError(
                f"no recipe {path.stem!r}.{near} Give {', '.join(known)}, or a recipe's TOML file"
            )
        path = known[name]
    try:
        return Recipe.model_validate(read_toml(path))
    except ValidationError as error:
        raise RecipeError(f"{path}: {first_problem(error)}") from error
    except UnicodeDecodeError as error:
        raise RecipeError(
            f"{path} is a binary file, not a recipe: see `nlos-cam recipes`"
        ) from error
    except (OSError, tomllib.TOMLDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecipeError(
            f"{path} cannot be read as a recipe ({reason}): see `nlos-cam recipes`"
        ) from error


PLATEAU_FACTOR = 0.3
PLATEAU_PATIENCE = 5
SMALLEST_RATE = 1e-8
"""SI 3 and 4: factor of the learning rate after this many epochs without progress; a smaller rate
ends the run.
"""
SMALLEST_SHARE = 0.01
"""Share of the rate that a cosine schedule ends with."""
WARM_UP = 0.15
"""Share of a one-cycle run in which the rate rises."""


def schedule_of(recipe: Recipe, optimizer: "torch.optim.Optimizer", steps: int) -> Any:
    """Return the recipe's schedule: one-cycle or cosine over `steps`, stepped at each, or plateau,
    at each epoch.
    """
    import torch  # late: dataset workers read recipes' constants, and torch takes seconds

    if recipe.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            recipe.learning_rate,
            total_steps=steps,
            pct_start=WARM_UP,
            cycle_momentum=False,
        )
    if recipe.schedule == "cosine":
        warm_up = min(recipe.warm_up_steps, steps // 2)

        def share(step: int) -> float:
            if step < warm_up:
                return (step + 1) / warm_up
            through = min(1.0, (step - warm_up) / max(1, steps - warm_up))
            return SMALLEST_SHARE + (1 - SMALLEST_SHARE) * (1 + math.cos(math.pi * through)) / 2

        return torch.optim.lr_scheduler.LambdaLR(optimizer, share)
    return torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimizer,
        factor=PLATEAU_FACTOR,
        patience=PLATEAU_PATIENCE,
        eps=0.0,  # torch's default would keep the rate at 1.4e-8, and the run would not end
    )


def has_ended(recipe: Recipe, rate: float) -> bool:
    """Return True once a plateau's rate has fallen below SMALLEST_RATE; one-cycle ends with its
    last step.
    """
    return recipe.schedule == "plateau" and rate < SMALLEST_RATE
