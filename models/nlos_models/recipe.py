"""A training recipe: everything that decides a run, in one short TOML file; deviations from the paper say why."""

import tomllib
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from nlos_models.errors import RecipeError


class Recipe(BaseModel):
    """One training run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: Literal["vae", "compressor"]
    colour: bool = False
    """RGB albedo in the place of depth; simulation only, since the L515's laser is infrared."""
    seed: int = 0
    objects: int = Field(gt=0)
    """Training objects, by seeds 0, 1, ...; held-out ones come from other seeds."""
    held_out: int = Field(gt=0)
    epochs: int = Field(gt=0)
    batch: int = Field(gt=1)
    learning_rate: float = Field(gt=0)
    betas: tuple[float, float] = (0.5, 0.999)
    schedule: Literal["one-cycle", "plateau"] = "plateau"
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    kl_weight: float = 0.05
    left_noise: float = 0.2
    dropout: float = Field(default=0.5, ge=0, lt=1)
    latent_weight: float = 1.0
    image_weight: float = 0.0
    deviations: list[str] = Field(default_factory=list[str])
    """Where this recipe leaves the supporting information, and why."""

    @field_validator("batch")
    @classmethod
    def _no_more_than_objects(cls, batch: int, info: ValidationInfo) -> int:
        if batch > info.data.get("objects", batch):
            raise ValueError(f"a batch must not be larger than objects ({info.data['objects']})")
        return batch


def load_recipe(path: Path) -> Recipe:
    """A recipe from TOML. Raises RecipeError with the first problem."""
    try:
        return Recipe.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part) for part in problem["loc"])
        raise RecipeError(f"{path}: {field}: {problem['msg']} (got {problem['input']!r:.80})") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecipeError(f"{path} cannot be read as a recipe: {error}") from error
