"""Devices and processes of a training run: launch, errors across processes, seeds and shares of a
batch.
"""

import multiprocessing
from collections.abc import Callable
from functools import partial
from multiprocessing.queues import SimpleQueue
from traceback import format_exception_only
from typing import Any, Literal

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException

from nlos_cam.processes import safe_children
from nlos_models.errors import RecipeError, TrainingError
from nlos_models.training.recipe import Precision, Recipe

Accelerator = Literal["auto", "cpu", "cuda"]
Loss = Callable[[Any, float], Tensor]
"""Loss of a batch, given the share of the run's steps that is done."""


class LossStep(nn.Module):
    """Loss in the place of a module's forward pass, so that several processes average the gradients
    behind it.
    """

    def __init__(self, module: nn.Module, loss: Loss) -> None:
        super().__init__()
        self.module = module
        self._loss = loss

    def forward(self, batch: Any, done: float) -> Tensor:
        """Return the loss of one batch, given the share of the run's steps that is done."""
        return self._loss(batch, done)


def open_fabric(recipe: Recipe, *, accelerator: Accelerator = "auto", devices: int = 1) -> Fabric:
    """Return a fabric of `devices` processes, one per GPU or all on the CPU.

    Raises TrainingError where there are fewer GPUs, RecipeError where the processes cannot share a
    batch evenly.
    """
    # Shares of different size would weigh samples differently, since gradients are averaged over
    # processes.
    if recipe.batch % devices:
        raise RecipeError(
            f"a batch of {recipe.batch} cannot be shared evenly by {devices} processes: change"
            " either"
        )
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    gpus = torch.cuda.device_count()
    if accelerator == "cuda" and devices > gpus:
        requested = (
            f"{devices} GPU{'s' if devices > 1 else ''} requested, {gpus or 'none'} available"
        )
        raise TrainingError(f"{requested}: choose fewer --devices, or --accelerator cpu")
    # Processes are spawned, not forked: CUDA and the threads of a BLAS do not survive a fork.
    strategy = "ddp_spawn" if devices > 1 else "auto"
    precision = precision_on(accelerator, recipe)
    return Fabric(accelerator=accelerator, devices=devices, strategy=strategy, precision=precision)


def precision_on(device: str, recipe: Recipe) -> Precision:
    """Return the recipe's precision, or float32 on a CPU without wide vectors, where bfloat16 is
    emulated.

    Measured on two threads of an AMD EPYC without AVX-512: 25 samples per second in bfloat16, 235
    in float32.
    """
    # bfloat16 has float32's range, so that losses need no scaling as in float16; its 8 bits are
    # enough for products, while weights, sums and losses stay in float32.
    emulated = device == "cpu" and torch.backends.cpu.get_cpu_capability() in {"DEFAULT", "AVX2"}
    return "32-true" if emulated else recipe.precision


def launch(fabric: Fabric, work: Callable[..., Any], *arguments: Any) -> Any:
    """Run `work(fabric, *arguments)` in every process and return the leading one's result.

    With several processes, work, arguments and result have to be picklable. Errors of this package
    are raised as they are, that of the process which failed first; an interruption is passed on to
    all processes, waited for, and raised as KeyboardInterrupt.
    """
    # No other process, no pickling: a debugger, and a test's closures, work.
    if fabric.world_size == 1:
        return work(fabric, *arguments)
    # The error of one process ends the others, in their next sum of gradients, with errors that
    # say no more than that: the first one in the queue is the cause.
    with safe_children():
        errors = multiprocessing.get_context("spawn").SimpleQueue()
    try:
        with safe_children():
            result = fabric.launch(
                partial(_return_errors, work=work, arguments=arguments, errors=errors)
            )
    except (ProcessRaisedException, ProcessExitedException) as error:
        if not errors.empty():
            raise errors.get() from error
        # A process that a signal ended has no error of its own.
        raise _ended_early(str(error).strip().splitlines()[-1]) from error
    except KeyboardInterrupt:
        _end_all()
        raise
    if isinstance(result, BaseException):
        raise result
    return result


def _return_errors(
    fabric: Fabric,
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
    errors: SimpleQueue[Exception],
) -> Any:
    """Run in each process; return expected errors, since raised ones reach the parent only as a
    traceback's text. All errors but interruptions go into the queue too.
    """
    try:
        return work(fabric, *arguments)
    except KeyboardInterrupt as error:
        return error
    except Exception as error:
        # Raised across processes, an error arrives as a traceback's text; as a value it keeps its
        # class and message.
        if hasattr(error, "exit_code"):
            errors.put(error)
            return error
        errors.put(_ended_early(format_exception_only(error)[-1].strip()))
        raise


def _ended_early(reason: str) -> TrainingError:
    return TrainingError(f"a training process ended early ({reason}): repeat the command to resume")


def _end_all() -> None:
    """Ask the processes to save and end, and wait for them."""
    # SIGTERM first to all, then wait: each saves its state after the current step.
    children = multiprocessing.active_children()
    for child in children:
        child.terminate()
    for child in children:
        child.join()


def seed_of(*parts: int) -> int:
    """Return a seed for a tuple of numbers; their count goes in too, since numpy ignores zeros at
    the end.
    """
    # Sums of numbers would give epoch 1 step 2 and epoch 2 step 1 the same seed. The upper 63
    # bits, since torch takes signed seeds.
    return int(
        np.random.SeedSequence([*parts, len(parts)]).generate_state(1, np.uint64)[0] >> np.uint64(1)
    )


def share_of(batch: Any, rank: int, world: int) -> Any:
    """Return the share of a batch (a tensor, a tuple of them, or None) that belongs to process
    `rank` of `world`.
    """
    if world == 1 or batch is None:
        return batch
    if isinstance(batch, Tensor):
        return batch[rank::world]
    # Named tuples stay what they are: the losses read their fields.
    parts = [share_of(part, rank, world) for part in batch]
    return type(batch)(*parts) if hasattr(batch, "_fields") else tuple(parts)
