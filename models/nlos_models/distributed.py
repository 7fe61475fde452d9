"""One training run on one device or on several processes: who starts them, and what is whose."""

import multiprocessing
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException

from nlos_models.errors import RecipeError, TrainingError
from nlos_models.recipe import Recipe

Accelerator = Literal["auto", "cpu", "cuda"]
Loss = Callable[[Any, float], Tensor]
"""Of a batch, when such a share of the run's steps is done."""


class LossStep(nn.Module):
    """A loss as a module's forward: what several processes need, to average the gradients behind it."""

    def __init__(self, module: nn.Module, loss: Loss) -> None:
        super().__init__()
        self.module, self._loss = module, loss

    def forward(self, batch: Any, done: float) -> Tensor:
        """The loss of one batch, when such a share of the run's steps is done."""
        return self._loss(batch, done)


def open_fabric(recipe: Recipe, *, accelerator: Accelerator = "auto", devices: int = 1) -> Fabric:
    """A fabric on one device, or on several processes: one for each GPU, or on a CPU.

    Raises TrainingError where there are not so many GPUs, RecipeError where they cannot share a batch evenly.
    """
    if recipe.batch % devices:
        raise RecipeError(f"a batch of {recipe.batch} is not shared by {devices} processes evenly: change one of them")
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    there = torch.cuda.device_count()
    if accelerator == "cuda" and devices > there:
        raise TrainingError(f"{devices} GPUs asked for, {there} there: choose fewer --devices, or --accelerator cpu")
    strategy = "ddp_spawn" if devices > 1 else "auto"
    return Fabric(accelerator=accelerator, devices=devices, strategy=strategy, precision=recipe.precision)


def launched(fabric: Fabric, work: Callable[..., Any], *arguments: Any) -> Any:
    """What `work(fabric, *arguments)` returns in the leading process.

    With several processes all of that must be picklable. An error that one of them foresaw comes out as its own;
    an interruption is passed on to all, waited for, and raised as KeyboardInterrupt.
    """
    if fabric.world_size == 1:
        return work(fabric, *arguments)
    try:
        result = fabric.launch(partial(_guarded, work=work, arguments=arguments))
    except (ProcessRaisedException, ProcessExitedException) as error:
        last = str(error).strip().splitlines()[-1]
        raise TrainingError(f"a training process ended early ({last}): train again, it goes on") from error
    except KeyboardInterrupt:
        _end_all()
        raise
    if isinstance(result, BaseException):
        raise result
    return result


def _guarded(fabric: Fabric, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Runs in each process; what is raised there would reach no one but as a traceback's text."""
    try:
        return work(fabric, *arguments)
    except (ValueError, OSError, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) or hasattr(error, "exit_code"):
            return error
        raise


def _end_all() -> None:
    """Ask the processes to save and end, and wait until they did."""
    children = multiprocessing.active_children()
    for child in children:
        child.terminate()
    for child in children:
        child.join()


def seed_of(*parts: int) -> int:
    """A seed of its own for every tuple of numbers; their count goes in, as numpy ignores zeros at the end."""
    return int(np.random.SeedSequence([*parts, len(parts)]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def share_of(batch: Any, rank: int, world: int) -> Any:
    """The part of a batch (a tensor, or a tuple of them) that is this process's."""
    if world == 1:
        return batch
    if isinstance(batch, Tensor):
        return batch[rank::world]
    parts = [share_of(part, rank, world) for part in batch]
    return type(batch)(*parts) if hasattr(batch, "_fields") else tuple(parts)
