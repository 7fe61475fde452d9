"""The training loop: epochs of batches, a log, a checkpoint after each epoch that a killed run resumes from."""

import csv
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from nlos_models.errors import RecipeError
from nlos_models.recipe import Recipe

Batches = Callable[[torch.Generator], Iterable[Any]]
"""One epoch of batches, shuffled by the generator."""
Loss = Callable[[Any], Tensor]
Score = Callable[[], dict[str, float]]
OnStep = Callable[[int, int], None]
"""Called with the steps done and the steps in all."""

PLATEAU_FACTOR, PLATEAU_PATIENCE, SMALLEST_RATE = 0.3, 5, 1e-8
"""SI 3 and 4: the learning rate falls by this factor after this many epochs without progress, and ends the run."""


def _schedule(recipe: Recipe, optimizer: torch.optim.Optimizer, steps: int) -> Any:
    if recipe.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            recipe.learning_rate,
            total_steps=steps,
            pct_start=0.15,
            cycle_momentum=False,
        )
    return torch.optim.lr_scheduler.ReduceLROnPlateau(optimizer, factor=PLATEAU_FACTOR, patience=PLATEAU_PATIENCE)


def _log(path: Path, row: dict[str, float]) -> None:
    fresh = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow(row)


def fit(
    module: nn.Module,
    *,
    recipe: Recipe,
    steps_per_epoch: int,
    batches: Batches,
    loss: Loss,
    score: Score,
    folder: Path,
    on_step: OnStep,
    fabric: Fabric | None = None,
) -> None:
    """Train `module` in place; `loss` must run it. The folder keeps last.ckpt and log.csv; a second call resumes.

    An epoch is repeatable: its shuffle and noise depend on the recipe's seed and the epoch alone.
    """
    fabric = fabric or Fabric(accelerator="auto", devices=1, precision=recipe.precision)
    module.to(fabric.device)
    optimizer = torch.optim.Adam(
        [p for p in module.parameters() if p.requires_grad], recipe.learning_rate, recipe.betas
    )
    schedule = _schedule(recipe, optimizer, recipe.epochs * steps_per_epoch)
    networks = {"module": module, "optimizer": optimizer, "schedule": schedule}
    state: dict[str, Any] = {**networks, "epoch": 0, "recipe": recipe.model_dump_json()}
    folder.mkdir(parents=True, exist_ok=True)
    _resume(fabric, folder / "last.ckpt", state)
    for epoch in range(state["epoch"], recipe.epochs):
        if optimizer.param_groups[0]["lr"] < SMALLEST_RATE:
            break
        started = time.perf_counter()
        torch.manual_seed(recipe.seed * 100_003 + epoch)
        generator = torch.Generator().manual_seed(recipe.seed * 100_003 + epoch)
        module.train()

        def advance(step: int, before: int = epoch * steps_per_epoch) -> None:
            on_step(before + step, recipe.epochs * steps_per_epoch)

        mean_loss = _one_epoch(fabric, batches(generator), loss, optimizer, schedule, advance)
        module.eval()
        figures = score()
        rate = optimizer.param_groups[0]["lr"]
        if recipe.schedule == "plateau":
            schedule.step(figures["held_out_loss"])
        seconds = time.perf_counter() - started
        _log(folder / "log.csv", {"epoch": epoch, "rate": rate, "loss": mean_loss, **figures, "seconds": seconds})
        state["epoch"] = epoch + 1
        fabric.save(folder / "last.ckpt.part", state)
        (folder / "last.ckpt.part").replace(folder / "last.ckpt")


def _resume(fabric: Fabric, checkpoint: Path, state: dict[str, Any]) -> None:
    """Load the last epoch's state, if there is one. Raises RecipeError where another recipe made it."""
    wanted = state["recipe"]
    if checkpoint.exists():
        fabric.load(checkpoint, state)
    if state["recipe"] != wanted:
        raise RecipeError(f"{checkpoint.parent} holds a run of another recipe: choose another --out")


def _one_epoch(
    fabric: Fabric,
    batches: Iterable[Any],
    loss: Loss,
    optimizer: torch.optim.Optimizer,
    schedule: Any,
    advance: Callable[[int], None],
) -> float:
    total, count = 0.0, 0
    for batch in batches:
        with fabric.autocast():
            value = loss(fabric.to_device(batch))
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        if isinstance(schedule, torch.optim.lr_scheduler.OneCycleLR):
            schedule.step()
        total, count = total + value.item(), count + 1
        advance(count)
    return total / max(count, 1)
