"""Training loop with exact resume, on one or several processes.

The order of the batches follows from the recipe's seed and the epoch; the noise of a step from
these, the step and the process. So no state of a random generator is saved, and a run killed at any
moment resumes to the same weights. Each process takes its share of every batch: several processes
differ from one only in their noise, in the samples behind their batch norms, and in the order of
sums.
"""

import hashlib
import json
import math
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from nlos_models.errors import CheckpointError, ModelError, RecipeError, TrainingError
from nlos_models.training.distributed import (
    Loss,
    LossStep,
    open_fabric,
    precision_on,
    seed_of,
    share_of,
)
from nlos_models.training.recipe import Recipe, recipe_of
from nlos_models.training.run_files import (
    OnMessage,
    Scores,
    State,
    TensorBoardLog,
    read_best,
    read_last,
    write_best,
    write_last,
    write_log,
)
from nlos_models.training.schedule import has_ended, schedule_of

MINUTES = "minutes.log"
MINUTE_S = 60.0
"""Interval between lines of MINUTES."""
COMPILERS = ("torch._dynamo", "torch._inductor")
STOP_CHECK_STEPS = 10
"""Several processes agree every so often, in steps, on whether to stop."""

OnStep = Callable[[int, int], None]
"""Called with the number of steps done and of all steps."""
Batches = Callable[[torch.Generator], Iterable[Any]]
"""One epoch of batches, shuffled by the generator."""
Score = Callable[[], Scores]
Network = TypeVar("Network", bound=Callable[..., Any])


def _ignore(*_: object) -> None:
    """Do nothing."""


def digest_of(*parts: nn.Module | str | None) -> str:
    """Return the SHA-256 of a run's starting point: every bit of its networks, and texts such as
    checksums of data.
    """
    digest = hashlib.sha256()
    for part in parts:
        # A text is a name without values.
        tensors = part.state_dict() if isinstance(part, nn.Module) else {str(part): torch.zeros(0)}
        for name, tensor in tensors.items():
            digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Running:
    """Circumstances of a run; of these, only the number of processes and rounding change the
    weights.
    """

    fabric: Fabric | None = None
    """Launched; None: one device, a GPU if there is one."""
    stop: Callable[[], bool] = lambda: False
    """Called after each step; if it returns true, the run is saved and ends with
    KeyboardInterrupt.
    """
    on_message: OnMessage = _ignore
    on_step: OnStep = _ignore
    on_epoch: Callable[[Scores], None] = _ignore
    """Called with each new row of the log."""
    checkpoint_s: float = 300.0
    """Interval between saved states within an epoch."""
    tensorboard: bool = False
    compiled: bool = False
    """Run the networks through torch.compile, which needs a C++ compiler."""
    origin: str = ""
    """`digest_of` the starting point; a run with another origin is not resumed."""
    earlier_origin: str | None = None
    """Origin that earlier versions gave such a run, which is resumed too."""
    clock: Callable[[], float] = time.monotonic

    def fabric_for(self, recipe: Recipe) -> Fabric:
        """Return the fabric, or a new one on one device."""
        return self.fabric or open_fabric(recipe)

    def maybe_compile(self, network: Network) -> Network:
        """Return the network, or a part of one, compiled if that is asked for."""
        return compile_network(network) if self.compiled else network


def fit(
    module: nn.Module,
    *,
    recipe: Recipe,
    steps_per_epoch: int,
    batches: Batches,
    loss: Loss,
    score: Score,
    folder: Path,
    running: Running | None = None,
) -> Scores:
    """Train `module` in place, resuming the run in `folder`; return the figures of the epoch that
    the recipe keeps.

    `loss` has to run the module; `score` returns at least held_out_loss. Raises TrainingError where
    the run cannot continue, KeyboardInterrupt where it was stopped.
    """
    running = running or Running()
    run = _Run(module, recipe, steps_per_epoch, loss, folder, running)
    leads = run.leads
    # A plain loop: what a step is can be read from top to bottom; `run` has the state of a
    # checkpoint and what is done with it.
    rank = run.fabric.global_rank
    world = run.fabric.world_size
    fabric = run.fabric
    board = TensorBoardLog(folder, run.epoch) if leads and running.tensorboard else None
    with closing(board) if board else nullcontext():
        while run.has_epochs_left:
            start_s = running.clock()
            module.train()
            # The order of an epoch follows from its number, the noise of a step from the step's: no
            # state of a generator is saved, and a resumed run repeats neither.
            order = torch.Generator().manual_seed(seed_of(recipe.seed, run.epoch))
            for batch in islice(batches(order), run.step, None):
                torch.manual_seed(seed_of(recipe.seed, run.epoch, run.step, rank))
                with explain_compile_errors():
                    share_done = run.steps_done / run.steps_in_all
                    value = run.forward(fabric.to_device(share_of(batch, rank, world)), share_done)
                    run.stepper.zero_grad(set_to_none=True)
                    fabric.backward(value)

                # A batch with a few strange maps would move Adam's moments for hundreds of steps.
                if recipe.gradient_limit:
                    limit = recipe.gradient_limit
                    norm = fabric.clip_gradients(
                        run.forward, run.stepper, max_norm=limit, error_if_nonfinite=False
                    )
                    run.require_finite("gradient", float(norm if norm is not None else 0.0))
                run.stepper.step()
                # A plateau is judged on held-out losses, once an epoch.
                if recipe.schedule != "plateau":
                    run.schedule.step()
                run.take_average()

                run.total += value.detach().float()
                run.step += 1
                if leads:
                    run.log_minute()
                    running.on_step(run.steps_done, run.steps_in_all)
                # A process that stopped alone would leave the others waiting in the next sum of
                # gradients.
                stop = run.any_process_asks(stop=running.stop())
                if leads and (stop or running.clock() - run.saved_s >= running.checkpoint_s):
                    run.save()
                if stop:
                    run.report(
                        f"stopped in epoch {run.epoch}: the same command resumes from step"
                        f" {run.step}"
                    )
                    raise KeyboardInterrupt

            # Not a number in one process is not a number in the mean: all of them end.
            train_loss = float(run.over_all(run.total / max(run.step, 1), "mean"))
            run.require_finite("loss", train_loss)
            # Scored with the averaged weights, which are the ones that are kept.
            module.eval()
            with run.averaged():
                figures: Scores = fabric.broadcast(score() if leads else {})
                run.require_finite("held-out loss", figures["held_out_loss"])
                run.keep_best(figures)
            run.end_epoch(train_loss, figures, running.clock() - start_s)
            if leads:
                if board:
                    board.add(run.rows[-1])
                running.on_epoch(run.rows[-1])
    return run.restore_best()


class _Run:
    """State of a run as a checkpoint holds it: module, optimizer, schedule, counters and log; owned
    by `fit`.

    Opening it resumes the run in `folder`. Raises RecipeError where another recipe or origin made
    that run.
    """

    def __init__(
        self,
        module: nn.Module,
        recipe: Recipe,
        steps: int,
        loss: Loss,
        folder: Path,
        running: Running,
    ) -> None:
        if steps < 1:
            raise RecipeError(
                f"fewer training objects than a batch of {recipe.batch}: choose more, or a smaller"
                " batch"
            )
        self.module = module
        self.recipe = recipe
        self.folder = folder
        self._running = running
        self.fabric = running.fabric_for(recipe)
        self.leads = self.fabric.is_global_zero
        if precision_on(self.fabric.device.type, recipe) != recipe.precision:
            self.report(
                "this processor emulates bfloat16: training in float32, which is several times"
                " faster here"
            )

        # Decay goes into the step, not into the gradient, where Adam would divide it by the
        # gradient's own spread (Loshchilov and Hutter 2019).
        free = [p for p in module.parameters() if p.requires_grad]
        kind = torch.optim.AdamW if recipe.weight_decay else torch.optim.Adam
        # One pass over each parameter: on a CPU a tenth of a step's time is saved.
        self.optimizer = kind(
            free, recipe.learning_rate, recipe.betas, weight_decay=recipe.weight_decay, fused=True
        )
        self.average = [p.detach().clone() for p in free] if recipe.average else []
        """Moving average of the free parameters, in their order."""
        self._free = free
        # The loss is inside of what is set up: with several processes, gradients are averaged
        # behind a forward pass.
        self.forward, self.stepper = self.fabric.setup(LossStep(module, loss), self.optimizer)
        self._steps = steps
        self.steps_in_all = recipe.epochs * steps
        self.schedule = schedule_of(recipe, self.optimizer, self.steps_in_all)
        self.epoch = 0
        self.step = 0
        self.rows = list[Scores]()
        self.total = torch.zeros((), device=self.fabric.device)
        """Sum of the epoch's losses so far."""
        if self.leads:
            folder.mkdir(parents=True, exist_ok=True)
        self._resume()
        self.average = [average.to(self.fabric.device) for average in self.average]
        self.saved_s = self._minute_s = running.clock()
        self._minute_steps = self.steps_done

    @property
    def has_epochs_left(self) -> bool:
        return self.epoch < self.recipe.epochs and not has_ended(self.recipe, self._rate)

    @property
    def steps_done(self) -> int:
        return self.epoch * self._steps + self.step

    @property
    def _rate(self) -> float:
        return self.optimizer.param_groups[0]["lr"]

    def require_finite(self, name: str, value: float) -> None:
        """Raise TrainingError where a value of this epoch is not a finite number."""
        if math.isfinite(value):
            return
        advice = "choose a smaller learning_rate"
        if self._running.compiled:
            # Seen with torch 2.13 on a Xeon with AMX: finite without it, from the same weights.
            advice = f"drop --compile, whose bfloat16 fails on some processors, or {advice}"
        raise TrainingError(f"the {name} is {value} in epoch {self.epoch}: {advice}")

    def report(self, message: str) -> None:
        """Pass a message on from the leading process alone."""
        if self.leads:
            self._running.on_message(message)

    def over_all(self, value: Tensor, how: str) -> Tensor:
        """Return the mean or sum of a number over the processes."""
        return cast("Tensor", self.fabric.all_reduce(value, reduce_op=how))

    def any_process_asks(self, *, stop: bool) -> bool:
        """Return the same answer in every process: true where one of them asks to stop at a step of
        agreement.
        """
        # Agreeing costs a message between processes, so that it happens every tenth step.
        if self.fabric.world_size == 1:
            return stop
        if self.steps_done % STOP_CHECK_STEPS:
            return False
        return bool(self.over_all(torch.tensor(float(stop), device=self.fabric.device), "sum"))

    def take_average(self) -> None:
        """Move the average of the weights towards them; early on by more, so that it forgets the
        first ones.
        """
        # The average of the last 1 / (1 - decay) steps has less of the noise of single batches, as
        # if the rate had fallen already (Polyak and Juditsky 1992). Over the first steps it is near
        # the plain mean, whose decay is t / (t + 1): the start would else weigh for a whole run.
        if self.average:
            decay = min(self.recipe.average, self.steps_done / (self.steps_done + 10))
            for average, own in zip(self.average, self._free, strict=True):
                average.lerp_(own.detach(), 1 - decay)

    @contextmanager
    def averaged(self) -> Generator[None]:
        """Put the averaged weights into the module, if there are any; put its own back
        afterwards.
        """
        self._exchange_with_average()
        try:
            yield
        finally:
            self._exchange_with_average()

    def _exchange_with_average(self) -> None:
        """Exchange the module's weights and the average's: pointers, no memory is copied."""
        if not self.average:
            return
        for own, average in zip(self._free, self.average, strict=True):
            own.data, average.data = average.data, own.data

    def log_minute(self) -> None:
        """Append a line to MINUTES: steps done, rate, mean loss of the epoch so far, samples per
        second.
        """
        seconds = self._running.clock() - self._minute_s
        if seconds < MINUTE_S:
            return
        # Since the last line, not since the start: a machine that slows down shows.
        pace = (self.steps_done - self._minute_steps) * self.recipe.batch / seconds
        line = (
            f"{time.strftime('%Y-%m-%dT%H:%M:%S')} epoch {self.epoch} step"
            f" {self.steps_done}/{self.steps_in_all}"
        )
        mean = float(self.total) / max(self.step, 1)
        with (self.folder / MINUTES).open("a", encoding="utf-8") as file:
            file.write(f"{line} rate {self._rate:.3g} loss {mean:.4g} samples/s {pace:.0f}\n")
        self._minute_s = self._running.clock()
        self._minute_steps = self.steps_done

    def keep_best(self, figures: Scores) -> None:
        """Write the module as the best state if its held-out loss is the smallest so far."""
        if self.leads and all(
            figures["held_out_loss"] < earlier["held_out_loss"] for earlier in self.rows
        ):
            # Of averaged weights, where there are any: `averaged` has put them into the module.
            write_best(self.folder, {"epoch": self.epoch, "module": self.module.state_dict()})

    def end_epoch(self, loss: float, figures: Scores, seconds: float) -> None:
        """Log the epoch, step a plateau's schedule, and save the state."""
        # The rate that the epoch trained with, before the schedule lowers it.
        self.rows.append(
            {"epoch": self.epoch, "rate": self._rate, "loss": loss, **figures, "seconds": seconds}
        )
        if self.recipe.schedule == "plateau":
            self.schedule.step(figures["held_out_loss"])
        self.epoch = self.epoch + 1
        self.step = 0
        self.total = torch.zeros_like(self.total)
        if self.leads:
            write_log(self.folder, self.rows)
            self.save()

    def restore_best(self) -> Scores:
        """Load the epoch that the recipe keeps into the module, and return its figures."""
        # Averaged weights are what is handed on; the run's own stay in the last state, for a
        # resume.
        row = self.rows[-1]
        self._exchange_with_average()
        if self.recipe.keep == "best":
            self.fabric.barrier()  # the leader may still be writing it
            best = read_best(self.folder)
            self.fabric.barrier()  # the leader removes it at the end of the run
            self.module.load_state_dict(best["module"])
            row = self.rows[best["epoch"]]
        return {
            name: value
            for name, value in row.items()
            if name not in {"epoch", "rate", "loss", "seconds"}
        }

    def save(self) -> None:
        """Write the last state."""
        parts = {
            name: getattr(self, name).state_dict() for name in ("module", "optimizer", "schedule")
        }
        facts = {"epoch": self.epoch, "step": self.step, "total": self.total, "rows": self.rows}
        facts |= {"average": self.average} if self.average else {}
        source = {"recipe": self.recipe.model_dump_json(), "origin": self._running.origin}
        write_last(self.folder, {**parts, **facts, **source})
        self.saved_s = self._running.clock()

    def _resume(self) -> None:
        state = read_last(self.folder, self.report)
        if state is None:
            return
        try:
            self._restore(state)
        except ModelError:
            raise
        except Exception as error:  # its parts have other types than ours
            raise CheckpointError(
                f"{self.folder} holds no state of such a run: choose another --out"
            ) from error

    def _restore(self, state: State) -> None:
        if not self.recipe.trains_like(recipe_of(json.loads(state["recipe"]))):
            raise RecipeError(f"{self.folder} holds a run of another recipe: choose another --out")
        # States of old runs have no origin.
        origins = self._running.origin, self._running.earlier_origin
        if state.get("origin", origins[0]) not in origins:
            raise RecipeError(
                f"{self.folder} holds a run from other weights or objects: choose another --out"
            )
        for name in ("module", "optimizer", "schedule"):
            getattr(self, name).load_state_dict(state[name])
        self.epoch = state["epoch"]
        self.step = state["step"]
        self.rows = state["rows"]
        self.total = state["total"].to(self.fabric.device)
        self.average = state.get("average", self.average)


def compile_network(network: Network) -> Network:
    """Wrap a network, or a part of one, in torch.compile; it is compiled on its first forward and
    backward pass.

    Random numbers are drawn as without compilation, so that a run may be resumed either way.
    """
    # Draws of dropout and noise come from torch's own generator either way.
    return cast("Network", torch.compile(network, options={"fallback_random": True}))


@contextmanager
def explain_compile_errors() -> Generator[None]:
    """Raise TrainingError where torch.compile fails in a step forwards and back; other errors
    pass.
    """
    try:
        yield
    except RuntimeError as error:
        if not type(error).__module__.startswith(COMPILERS):
            raise
        # A missing compiler shows itself at the first step, inside the compiler's own errors.
        reason = str(getattr(error, "inner_exception", error)).strip().splitlines()[0]
        raise TrainingError(
            f"--compile does not work here ({reason}): install a C++ compiler (g++), or drop"
            " --compile"
        ) from error
