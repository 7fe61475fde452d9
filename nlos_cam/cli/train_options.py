"""The options that the three `train` commands share, each written once."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from lightning_fabric import Fabric
from nlos_models.processes import Accelerator, open_fabric
from nlos_models.recipe import Recipe, load_recipe

from nlos_cam.cli.common import Json
from nlos_cam.errors import SceneError

Budget = Annotated[float, typer.Option("--budget", min=1e-4, max=1.0, help="Share of the recipe's budget.")]


@dataclass(frozen=True)
class RunOptions:
    """What is run, where to, and how; each field is an option of every command."""

    recipe_file: Annotated[
        Path, typer.Option("--recipe", help="A training recipe (models/recipes).", show_default=False)
    ]
    out: Annotated[Path, typer.Option("--out", help="The run's folder: log, checkpoints, weights. Resumes there.")]
    objects: Annotated[int | None, typer.Option("--objects", min=2, help="Train on so many, not on the recipe's.")] = (
        None
    )
    devices: Annotated[int, typer.Option("--devices", min=1, help="Processes: one for each GPU, or on the CPU.")] = 1
    accelerator: Annotated[Accelerator, typer.Option("--accelerator", help="auto is a GPU if there is one.")] = "auto"
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Log for TensorBoard too, beside log.csv.")] = False
    compiled: Annotated[
        bool, typer.Option("--compile", help="Networks through torch.compile: faster; needs a C++ compiler.")
    ] = False
    json: Json = False

    def recipe(self, task: str, budget: float = 1.0) -> Recipe:
        """The recipe, at a share of its budget. Raises SceneError where it is another task's."""
        recipe = load_recipe(self.recipe_file)
        if recipe.task != task:
            told = f"{self.recipe_file} is a recipe for {recipe.task!r}, not {task!r}"
            raise SceneError(f"{told}: choose another --recipe")
        if self.objects is not None:
            recipe = recipe.of_objects(self.objects)
        return recipe.scaled(budget)

    def fabric(self, recipe: Recipe) -> Fabric:
        """What the recipe is run on."""
        return open_fabric(recipe, accelerator=self.accelerator, devices=self.devices)


def refuse_ignored(why: str, given: dict[str, bool]) -> None:
    """Raise SceneError for the first option that is given and would be ignored."""
    for option in (option for option, is_given in given.items() if is_given):
        raise SceneError(f"{why}, so that {option} would do nothing: leave it out, or change the recipe")


def with_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command as typer wants it: the fields of RunOptions, spelt out, in the place of its parameter `run`."""
    shared = inspect.signature(RunOptions).parameters
    own = [each for name, each in inspect.signature(command).parameters.items() if name != "run"]

    @wraps(command)
    def spelt_out(**given: Any) -> None:
        command(run=RunOptions(**{name: given.pop(name) for name in shared}), **given)

    every = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*shared.values(), *own)]
    spelt_out.__annotations__ = {each.name: each.annotation for each in every}
    spelt_out.__dict__["__signature__"] = inspect.Signature(every)
    return spelt_out


Maps = Annotated[Path, typer.Option("--dataset", help="Training maps, from `dataset build` or of recordings.")]


HeldOut = Annotated[Path, typer.Option("--held-out", help="Maps to judge by, of other objects.")]
