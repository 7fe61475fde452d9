"""Training recipes: one record for each of five tasks, read from short TOML files that state their
deviations from the paper.
"""

import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from nlos_cam.files import read_toml
from nlos_models.errors import RecipeError, UnknownRecipeError, first_problem

MapKind = Literal["raw maps", "difference maps"]
"""Input of a network; difference maps are maps minus the bare wall's."""
ImageLoss = Literal["squared", "absolute"]
"""Error of a pixel; the best answer is the mean ("squared") or median ("absolute") of possible
images.
"""
Precision = Literal["32-true", "bf16-mixed"]
"""Of the products; on a CPU that emulates bfloat16, float32 takes its place
(`distributed.precision_on`).
"""
Share = Annotated[float, Field(ge=0, lt=1)]
Weight = Annotated[float, Field(ge=0)]
SurfaceWeight = Annotated[float, Field(ge=1)]
"""Weight of a surface pixel in an image's error, relative to a background pixel
(`losses.image_error`).
"""


class Recipe(BaseModel, frozen=True, extra="forbid"):
    """Parameters that a training run of every task has."""

    task: str
    colour: bool = False
    """Train on RGB albedo in place of depth, in simulation only."""
    seed: int = Field(default=0, ge=0, lt=2**63)
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
    betas: tuple[Share, Share] = (0.5, 0.999)
    schedule: Literal["one-cycle", "plateau", "cosine"] = "plateau"
    warm_up_steps: int = Field(default=100, ge=0)
    """Cosine schedule: steps in which the rate rises."""
    weight_decay: Weight = 0.0
    """Decoupled, as in AdamW; 0: Adam."""
    average: Share = 0.0
    """Decay of the moving average of the weights, which is then what is scored and kept; 0:
    none.
    """
    gradient_limit: Weight = 0.0
    """Largest norm of the gradients, which are scaled down to it; 0: none."""
    precision: Precision = "32-true"
    keep: Literal["last", "best"] = "last"
    """Epoch whose weights are saved; the best one has the smallest held-out loss."""
    deviations: list[str] = Field(default_factory=list[str])
    """Deviations from the supporting information, each with its reason."""

    @model_validator(mode="before")
    @classmethod
    def _drop_fields_of_other_tasks(cls, facts: Any) -> Any:
        """Accept records of earlier versions, which name the fields of all tasks at their
        defaults.
        """
        if not isinstance(facts, dict):
            return facts
        # A field of another task at its default says nothing; at another value it is a mistake,
        # and stays to be refused by `extra`.
        own = cls.model_fields
        return {
            name: value
            for name, value in facts.items()
            if name in own or name not in EARLIER or value != EARLIER[name]
        }

    @model_validator(mode="after")
    def _check_batch(self) -> Self:
        if self.batch > self.objects:
            raise ValueError(f"a batch of {self.batch} is larger than objects ({self.objects})")
        return self

    def trains_like(self, other: "Recipe") -> bool:
        """Return True where two recipes differ in the wording of their deviations alone."""
        return self.model_copy(update={"deviations": other.deviations}) == other

    def scaled(self, share: float) -> Self:
        """Return the recipe at a share of its budget (objects x epochs): fewer epochs, and objects
        below one epoch.

        Raises RecipeError for a share outside (0, 1].
        """
        if not 0 < share <= 1:
            raise RecipeError(f"--budget must be above 0 and at most 1, got {share:g}")
        if share == 1:
            return self
        # Fewer epochs first: an epoch with fewer objects would be another data set.
        epochs = max(1, round(self.epochs * share))
        objects = max(self.batch, round(self.objects * min(1.0, self.epochs * share / epochs)))
        deviation = (
            f"{share:g} of the budget: {epochs} epochs of {objects} objects, not {self.epochs} of"
            f" {self.objects}"
        )
        deviations = [*self.deviations, deviation]
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


class VaeRecipe(Recipe, frozen=True):
    """Recipe of a Res-VAE on images (SI 3)."""

    task: Literal["vae"]
    start: Literal["scratch", "weights", "decoder"] = "scratch"
    """Random initial weights; or those of an earlier run (--weights); or an untrained encoder
    before the decoder of such weights, which stays as it is."""
    kl_weight: float = 0.05
    latent_warm_up: float = Field(default=0.0, ge=0, le=0.5)
    """Share of the run as a plain autoencoder; noise and divergence then rise over an equal
    share.
    """
    surface_weight: SurfaceWeight = 1.0
    image_loss: ImageLoss = "squared"
    augmentation: Literal["mirror", "turns"] = "mirror"
    """Mirror about y = 0, the rig's only symmetry; or quarter turns as well (SI 3)."""
    left_out: list[str] = Field(default_factory=list[str])
    """Object categories left out of the training; for other tasks the dataset's plan decides."""
    backgrounds: float = Field(default=0.0, ge=0, le=1)
    """Share of the objects with a post or a panel beside them."""


class _MapsToLatent(Recipe, frozen=True):
    """Parameters of the runs that train a compressor."""

    left_noise: float = 0.2
    dropout: Share = 0.5
    latent_weight: Weight = 1.0
    image_weight: Weight = 0.0
    surface_weight: SurfaceWeight = 1.0
    image_loss: ImageLoss = "squared"
    maps: MapKind = "raw maps"

    @model_validator(mode="after")
    def _check_loss(self) -> Self:
        if not self.latent_weight + self.image_weight:
            raise ValueError("latent_weight and image_weight are both 0: set at least one of them")
        return self


class CompressorRecipe(_MapsToLatent, frozen=True):
    """Recipe of a compressor onto a VAE's latent (SI 4), or with its decoder end to end."""

    task: Literal["compressor"]
    start: Literal["scratch", "weights"] = "scratch"
    """Random initial weights, or those of an earlier run (--weights)."""
    steps: Literal["two", "one", "two-then-joint"] = "two"
    """Compressor onto a VAE's latent; or compressor and decoder end to end, from scratch or from
    two-step weights.
    """
    width: float = Field(default=1.0, gt=0, le=2)
    """Channels of the layers as a share of Table S2's."""
    kl_weight: float = 0.05
    """Of the VAE that the run aims at; for the record, without effect here."""

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        if self.steps == "one" and self.latent_weight:
            raise ValueError("steps = 'one' has no target latent: set latent_weight = 0")
        if self.steps != "two" and not self.image_weight:
            raise ValueError(
                f"steps = {self.steps!r} trains a decoder, which needs an image loss: set"
                " image_weight"
            )
        if self.steps != "two" and self.start == "weights":
            raise ValueError("start = 'weights' is for steps = 'two': drop it")
        return self

    @model_validator(mode="after")
    def _check_color(self) -> Self:
        if self.colour and self.maps != "raw maps":
            raise ValueError("colour = true is simulation only and uses raw maps: drop maps")
        if self.colour and self.width != 1:
            raise ValueError("width applies to a compressor of depth only: drop it")
        return self


class TransferRecipe(_MapsToLatent, frozen=True):
    """Recipe of fine-tuning on a bench's recordings in two phases (SI 4), of either network."""

    task: Literal["transfer"]
    colour: Literal[False] = False
    all_layers_epochs: int = Field(default=4, ge=0)
    """Epochs of the first phase (SI 4: 3 to 5); the second phase starts from the epoch chosen by
    `keep`.
    """
    statistics: Literal["kept", "own", "own intensity"] = "kept"
    """Normalise all maps as the synthetic ones, or all channels (or intensity alone) by the
    recordings' own mean and spread."""
    noise: Weight = 0.0
    """Direct network: standard deviation of the noise added to normalised maps."""


class DirectSize(BaseModel, frozen=True, extra="forbid"):
    """Widths and depths of a direct network."""

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


class DirectRecipe(Recipe, frozen=True):
    """Recipe of a direct network."""

    task: Literal["direct"]
    start: Literal["scratch", "weights"] = "scratch"
    """Random initial weights, or those of an earlier run (--weights)."""
    dropout: Share = 0.5
    noise: Weight = 0.0
    """Standard deviation of the noise added to normalised maps."""
    wall_texture: float = Field(default=0.0, ge=0, le=0.5)
    """Each sample's wall has a reflectance whose logarithm varies by up to this standard
    deviation.
    """
    range_offset_m: float = Field(default=0.0, ge=0, le=0.1)
    """Standard deviation of the range offset of each sample's lidar."""
    blend: float = Field(default=1.0, gt=0, le=1)
    """Share of the trained weights in their mean with those that the run started from, which keeps
    what the new maps do not show (Wortsman et al. 2022, "Robust fine-tuning of zero-shot
    models")."""
    direct: DirectSize = DirectSize()

    @model_validator(mode="after")
    def _check_blend(self) -> Self:
        if self.blend != 1 and self.start != "weights":
            raise ValueError("blend is for a run with start = 'weights': drop it")
        return self


class UncertaintyRecipe(Recipe, frozen=True):
    """Recipe of the uncertainty network of trained weights."""

    task: Literal["doubt"]
    colour: Literal[False] = False
    outliers: int = Field(gt=0)
    """Number of outliers of each out-of-distribution kind."""
    empties: int = Field(gt=0)
    """Number of views of benches with nothing hidden."""


MapRecipe = CompressorRecipe | TransferRecipe
"""Recipes of runs on maps that a dataset holds."""
AnyRecipe = Annotated[
    VaeRecipe | CompressorRecipe | TransferRecipe | DirectRecipe | UncertaintyRecipe,
    Field(discriminator="task"),
]
KINDS: dict[str, type[Recipe]] = {
    "vae": VaeRecipe,
    "compressor": CompressorRecipe,
    "transfer": TransferRecipe,
    "doubt": UncertaintyRecipe,
    "direct": DirectRecipe,
}
EARLIER: dict[str, Any] = {
    "start": "scratch",
    "kl_weight": 0.05,
    "latent_warm_up": 0.0,
    "left_noise": 0.2,
    "dropout": 0.5,
    "width": 1.0,
    "latent_weight": 1.0,
    "image_weight": 0.0,
    "surface_weight": 1.0,
    "image_loss": "squared",
    "augmentation": "mirror",
    "left_out": [],
    "backgrounds": 0.0,
    "steps": "two",
    "maps": "raw maps",
    "all_layers_epochs": 4,
    "statistics": "kept",
    "noise": 0.0,
    "wall_texture": 0.0,
    "range_offset_m": 0.0,
    "blend": 1.0,
    "direct": DirectSize().model_dump(),
    "outliers": 0,
    "empties": 0,
}
"""Defaults of the fields that a record names in each recipe, whatever its task, since recipes had
one class; a field elsewhere than in its task is refused at any other value.
"""


def recipe_of(facts: dict[str, Any]) -> Recipe:
    """Return a recipe of the task that its fields name. Raises ValidationError, or ValueError for
    another task.
    """
    task = facts.get("task")
    if not isinstance(task, str) or task not in KINDS:
        raise ValueError(f"task: must be one of {', '.join(KINDS)} (got {task!r})")
    return KINDS[task].model_validate(facts)


def maps_of(recipe: Recipe) -> MapKind:
    """Return the kind of maps that the recipe's network takes."""
    return recipe.maps if isinstance(recipe, MapRecipe) else "raw maps"


def packaged_recipes() -> dict[str, Path]:
    """Return the recipes that come with the package (in a clone: models/recipes) by name, less
    "paper-rig-".
    """
    package = Path(__file__).parents[1]
    folders = (package / "recipes", package.parent / "recipes")
    folder = next((folder for folder in folders if folder.is_dir()), package)
    return {path.stem.removeprefix("paper-rig-"): path for path in sorted(folder.glob("*.toml"))}


def load_recipe(path: Path) -> Recipe:
    """Read a recipe from TOML, or a packaged one by name. Raises RecipeError with the first
    problem.
    """
    if str(path) == path.stem and not path.is_file():  # the run's own folder may be called so
        path = _find_packaged(path.stem)
    try:
        return recipe_of(read_toml(path))
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
    except ValueError as error:
        raise RecipeError(f"{path}: {error}") from error


def _find_packaged(given: str) -> Path:
    known = packaged_recipes()
    name = given.removeprefix("paper-rig-")
    if name in known:
        return known[name]
    near = "".join(f" Did you mean {match!r}?" for match in get_close_matches(name, known, 1))
    raise UnknownRecipeError(
        f"no recipe {given!r}.{near} Give {', '.join(known)}, or a recipe's TOML file"
    )
