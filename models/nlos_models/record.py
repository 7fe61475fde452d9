"""The record beside a checkpoint's tensors: which runs made them, for which rig, and how well they did."""

from collections.abc import Iterable
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from nlos_models.recipe import SIMULATION_ONLY, MapKind, Recipe


class CheckpointRecord(BaseModel):
    """What the tensors cannot say."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig_name: str
    rig_checksum: str
    input: MapKind = "raw maps"
    """What the compressor eats; difference maps are the maps less the bare wall's."""
    vae_recipe: Recipe | None = None
    """None for a compressor and decoder that were trained in one step."""
    compressor_recipe: Recipe | None = None
    """None for a VAE alone."""
    transfer_recipe: Recipe | None = None
    """None for weights that saw synthetic maps alone."""
    earlier: list[Recipe] = []
    """Of the runs that those above went on from, the oldest first."""
    figures: dict[str, float] = {}
    """Held-out figures at the end of training."""
    note: str = Field(default="", validate_default=True)
    """Where weights are of colour, that these are simulation only; always so, whatever is given."""

    @field_validator("note")
    @classmethod
    def _noted(cls, note: str, info: ValidationInfo) -> str:
        del note
        return SIMULATION_ONLY if _in_colour(info.data.get("vae_recipe"), info.data.get("compressor_recipe")) else ""

    @classmethod
    def of(cls, runs: Iterable[Recipe], rig: tuple[str, str], maps: MapKind = "raw maps") -> Self:
        """Of weights that these runs made, the oldest first, for a rig of this name and checksum."""
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
        """The recipes of all runs behind these weights, the oldest first."""
        own = (self.vae_recipe, self.compressor_recipe, self.transfer_recipe)
        return [*self.earlier, *(recipe for recipe in own if recipe)]

    @property
    def vae_runs(self) -> list[Recipe]:
        """Those of them that made encoder and decoder."""
        return [recipe for recipe in self.runs if recipe.task == "vae" or recipe.steps == "two-then-joint"]

    @property
    def width(self) -> float:
        """Of the compressor's layers, as a share of Table S2's."""
        return self.compressor_recipe.width if self.compressor_recipe else 1.0

    @property
    def colour(self) -> bool:
        """Whether these are weights of full colour, which is simulation only."""
        return _in_colour(self.vae_recipe, self.compressor_recipe)


def _in_colour(*recipes: Recipe | None) -> bool:
    return any(recipe is not None and recipe.colour for recipe in recipes)
