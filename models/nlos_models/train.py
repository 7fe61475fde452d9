"""The training loop: epochs of batches on one or many processes; killed at any moment, it goes on to the same weights.

The order of the batches depends on the recipe's seed and the epoch alone, the noise of a step on these, the step and
the process: no state of a random generator needs to be kept. Each process takes its share of every batch, so that
several differ from one only in their noise, their batch norms' samples, and the order of sums.

The files of a training run: checkpoints that a kill at any moment leaves whole, and the log.

TensorBoard logs of a training run; the package `tensorboard` is imported only where they are wanted.

Networks through torch.compile: the same noise, dropout and figures within rounding, in less time.
"""

import csv
import hashlib
import io
import math
import os
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from nlos_models.distributed import Loss, LossStep, open_fabric, seed_of, share_of
from nlos_models.errors import CheckpointError, RecipeError, TrainingError
from nlos_models.recipe import Recipe, has_ended, schedule_of

LAST, PREVIOUS, BEST, LOG = "last.ckpt", "previous.ckpt", "best.ckpt", "log.csv"
DIGEST = hashlib.sha256().digest_size

State = dict[str, Any]
Tell = Callable[[str], None]


def write_last(folder: Path, state: State) -> None:
    """Make this the run's last state; the one that was last becomes the previous. Raises TrainingError."""
    part = _write(folder / LAST, _packed(state))
    if (folder / LAST).exists():
        (folder / LAST).replace(folder / PREVIOUS)
    part.replace(folder / LAST)


def write_best(folder: Path, state: State) -> None:
    """Make this the run's best state. Raises TrainingError where it cannot be written."""
    _write(folder / BEST, _packed(state)).replace(folder / BEST)


def write_log(folder: Path, rows: list[dict[str, float]]) -> None:
    """The whole log, one row an epoch. Raises TrainingError where it cannot be written."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    _write(folder / LOG, text.getvalue().encode()).replace(folder / LOG)


def read_last(folder: Path, tell: Tell) -> State | None:
    """The last state that is whole, None before the first; a damaged one is told of, and the previous taken.

    Raises CheckpointError where there are states, and none of them is whole.
    """
    damaged: list[Path] = []
    for path in (folder / LAST, folder / PREVIOUS):
        if path.exists():
            if (state := _unpacked(path)) is not None:
                if damaged:
                    tell(f"{damaged[0]} is damaged: going on from {path.name}, a few minutes earlier")
                return state
            damaged.append(path)
    if damaged:
        raise CheckpointError(f"{' and '.join(map(str, damaged))} damaged: delete {folder}, or choose another --out")
    return None


def read_best(folder: Path) -> State:
    """The best state. Raises CheckpointError where it is damaged or not there."""
    state = _unpacked(folder / BEST) if (folder / BEST).exists() else None
    if state is None:
        raise CheckpointError(f"{folder / BEST} is missing or damaged: train again into another --out")
    return state


def digest_of(*parts: nn.Module | str | None) -> str:
    """A word for networks, down to their last bit, and whatever else a run sets out from."""
    digest = hashlib.sha256()
    for part in parts:
        tensors = part.state_dict() if isinstance(part, nn.Module) else {str(part): torch.zeros(0)}
        for name, tensor in tensors.items():
            digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _packed(state: State) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getbuffer()
    return hashlib.sha256(content).digest() + content


def _unpacked(path: Path) -> State | None:
    """None where the file is not what was written."""
    raw = path.read_bytes()
    if len(raw) < DIGEST or hashlib.sha256(memoryview(raw)[DIGEST:]).digest() != raw[:DIGEST]:
        return None
    return torch.load(io.BytesIO(raw[DIGEST:]), map_location="cpu", weights_only=True)


def _write(path: Path, content: bytes) -> Path:
    """A file beside `path`, on the disk and whole, that is to be renamed to it."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        part.unlink(missing_ok=True)
        reason = error.strerror or error
        raise TrainingError(f"{path} cannot be written ({reason}): make room and train again, it goes on") from error
    return part


class Board:
    """One event file for each start of a run; what an earlier start logged of these epochs gives way."""

    def __init__(self, folder: Path, epoch: int) -> None:
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError as error:
            raise TrainingError(
                "TensorBoard logs need the package tensorboard: pip install 'nlos-cam[train]', or do without"
            ) from error
        self._writer: Any = SummaryWriter(str(folder / "tensorboard"), purge_step=epoch)

    def add(self, row: dict[str, float]) -> None:
        """One epoch's figures, drawn over the epoch."""
        for name, value in row.items():
            if name != "epoch":
                self._writer.add_scalar(name, value, int(row["epoch"]))
        self._writer.flush()

    def close(self) -> None:
        """End the file."""
        self._writer.close()


Network = TypeVar("Network", bound=Callable[..., Any])
COMPILERS = ("torch._dynamo", "torch._inductor")


def compiled(network: Network) -> Network:
    """The network, or part of one; it is compiled as it is first run, its gradients as they are first asked for.

    Random numbers are drawn as without it, so that a run may be gone on with either way.
    """
    return cast("Network", torch.compile(network, options={"fallback_random": True}))


@contextmanager
def compiling() -> Generator[None]:
    """Around a step forwards and back: raises TrainingError where a network cannot be compiled."""
    try:
        yield
    except RuntimeError as error:
        if not type(error).__module__.startswith(COMPILERS):
            raise
        reason = str(getattr(error, "inner_exception", error)).strip().splitlines()[0]
        raise TrainingError(
            f"--compile does not work here ({reason}): install a C++ compiler (g++), or do without"
        ) from error


Batches = Callable[[torch.Generator], Iterable[Any]]
"""One epoch of batches, shuffled by the generator."""
Score = Callable[[], dict[str, float]]
OnStep = Callable[[int, int], None]
"""Called with the steps done and the steps in all."""

STEPS_BETWEEN_WORDS = 10
"""After how many steps several processes agree on whether to stop."""


def _to_nobody(told: object) -> None:
    del told


@dataclass(frozen=True)
class Running:
    """How a run is run; none of it changes what comes out, but for the number of processes and rounding."""

    fabric: Fabric | None = None
    """Launched; None takes the best one device at hand."""
    stop: Callable[[], bool] = lambda: False
    """Asked after each step; where it says so, the run is saved and ends by KeyboardInterrupt."""
    tell: Tell = _to_nobody
    on_epoch: Callable[[dict[str, float]], None] = _to_nobody
    """Called with each new row of the log."""
    checkpoint_s: float = 300.0
    """How often a state is saved within an epoch."""
    tensorboard: bool = False
    compiled: bool = False
    """Whether networks run through torch.compile, which asks for a C++ compiler."""
    origin: str = ""
    """What the run sets out from, in a word (`run_files.digest_of`); that of another origin is not gone on with."""
    clock: Callable[[], float] = time.monotonic

    def on(self, recipe: Recipe) -> Fabric:
        """The fabric, or one device's."""
        return self.fabric or open_fabric(recipe)

    def quick(self, network: Network) -> Network:
        """The network, or part of one, as a step runs it."""
        return compiled(network) if self.compiled else network


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
    running: Running | None = None,
) -> dict[str, float]:
    """Train `module` in place and return the figures of the epoch it is left at; `loss` must run it.

    The folder keeps last.ckpt, previous.ckpt, best.ckpt and log.csv; a second call goes on where it was. `score` gives
    at least held_out_loss. Raises TrainingError where the run cannot go on, KeyboardInterrupt where it was stopped.
    """
    if steps_per_epoch < 1:
        raise RecipeError(f"fewer training objects than a batch of {recipe.batch}: choose more, or a smaller batch")
    run = _Run(module, recipe, steps_per_epoch, loss, folder, running or Running())
    board = Board(folder, run.epoch) if run.leads and run.running.tensorboard else None
    try:
        while run.goes_on:
            run.train(batches, on_step)
            run.judge(score, board)
    finally:
        if board:
            board.close()
    return run.hand_on()


class _Run:
    """Everything that a checkpoint holds, and the steps that change it."""

    def __init__(
        self, module: nn.Module, recipe: Recipe, steps: int, loss: Loss, folder: Path, running: Running
    ) -> None:
        self.recipe, self.steps, self.folder, self.running = recipe, steps, folder, running
        self.fabric = running.on(recipe)
        self.leads = self.fabric.is_global_zero
        self.module = module
        free = [p for p in module.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(free, recipe.learning_rate, recipe.betas)
        self._forward, self._optimizer = self.fabric.setup(LossStep(module, loss), self.optimizer)
        self._steps_in_all = recipe.epochs * steps
        self.schedule = schedule_of(recipe, self.optimizer, self._steps_in_all)
        self.epoch, self.step, self.rows = 0, 0, list[dict[str, float]]()
        self.total = torch.zeros((), device=self.fabric.device)
        if self.leads:
            folder.mkdir(parents=True, exist_ok=True)
        self._resume()
        self._saved_s = running.clock()

    @property
    def goes_on(self) -> bool:
        """Whether there is an epoch left to train."""
        return self.epoch < self.recipe.epochs and not has_ended(self.recipe, self._rate)

    @property
    def _steps_done(self) -> int:
        return self.epoch * self.steps + self.step

    @property
    def _rate(self) -> float:
        return self.optimizer.param_groups[0]["lr"]

    def train(self, batches: Batches, on_step: OnStep) -> None:
        """The steps of an epoch that are still to do."""
        self.started_s = self.running.clock()
        self.module.train()
        generator = torch.Generator().manual_seed(seed_of(self.recipe.seed, self.epoch))
        for batch in islice(batches(generator), self.step, None):
            self._advance(batch)
            if self.leads:
                on_step(self._steps_done, self._steps_in_all)
            self._pause()

    def _advance(self, batch: Any) -> None:
        rank, world = self.fabric.global_rank, self.fabric.world_size
        torch.manual_seed(seed_of(self.recipe.seed, self.epoch, self.step, rank))
        with compiling():
            done = self._steps_done / self._steps_in_all
            value = self._forward(self.fabric.to_device(share_of(batch, rank, world)), done)
            self._optimizer.zero_grad(set_to_none=True)
            self.fabric.backward(value)
        self._optimizer.step()
        if self.recipe.schedule == "one-cycle":
            self.schedule.step()
        self.total += value.detach().float()
        self.step += 1

    def _pause(self) -> None:
        """Save where that is due; end where it is asked for."""
        stop = self._agree_to_stop()
        if self.leads and (stop or self.running.clock() - self._saved_s >= self.running.checkpoint_s):
            self._save()
        if stop:
            if self.leads:
                self.running.tell(f"stopped in epoch {self.epoch}: the same command goes on from step {self.step}")
            raise KeyboardInterrupt

    def _agree_to_stop(self) -> bool:
        asked = self.running.stop()
        if self.fabric.world_size == 1:
            return asked
        if self._steps_done % STEPS_BETWEEN_WORDS:
            return False
        return bool(self._over_all(torch.tensor(float(asked), device=self.fabric.device), "sum"))

    def _over_all(self, value: Tensor, how: str) -> Tensor:
        """The mean or sum of a number over the processes."""
        return cast("Tensor", self.fabric.all_reduce(value, reduce_op=how))

    def judge(self, score: Score, board: Board | None) -> None:
        """End the epoch: figures, log, schedule, checkpoints. Raises TrainingError where the loss is not a number."""
        loss = float(self._over_all(self.total / max(self.step, 1), "mean"))
        if not math.isfinite(loss):
            raise TrainingError(f"the loss is {loss} in epoch {self.epoch}: choose a smaller learning_rate")
        self.module.eval()
        figures: dict[str, float] = self.fabric.broadcast(score() if self.leads else {})
        if not math.isfinite(figures["held_out_loss"]):
            raise TrainingError(
                f"the held-out loss is not a number in epoch {self.epoch}: choose a smaller learning_rate"
            )
        row = {"epoch": self.epoch, "rate": self._rate, "loss": loss, **figures}
        best = all(figures["held_out_loss"] < earlier["held_out_loss"] for earlier in self.rows)
        self.rows.append({**row, "seconds": self.running.clock() - self.started_s})
        if self.recipe.schedule == "plateau":
            self.schedule.step(figures["held_out_loss"])
        self.epoch, self.step, self.total = self.epoch + 1, 0, torch.zeros_like(self.total)
        if self.leads:
            self._keep(board, best=best)

    def _keep(self, board: Board | None, *, best: bool) -> None:
        if best:
            write_best(self.folder, {"epoch": self.epoch - 1, "module": self.module.state_dict()})
        write_log(self.folder, self.rows)
        self._save()
        if board:
            board.add(self.rows[-1])
        self.running.on_epoch(self.rows[-1])

    def hand_on(self) -> dict[str, float]:
        """Bring the module to the epoch that the recipe keeps; that epoch's figures."""
        row = self.rows[-1]
        if self.recipe.keep == "best":
            self.fabric.barrier()  # the leader may still be writing it
            best = read_best(self.folder)
            self.module.load_state_dict(best["module"])
            row = self.rows[best["epoch"]]
        return {name: value for name, value in row.items() if name not in {"epoch", "rate", "loss", "seconds"}}

    def _save(self) -> None:
        parts = {name: getattr(self, name).state_dict() for name in ("module", "optimizer", "schedule")}
        facts = {"epoch": self.epoch, "step": self.step, "total": self.total, "rows": self.rows}
        made_of = {"recipe": self.recipe.model_dump_json(), "origin": self.running.origin}
        write_last(self.folder, {**parts, **facts, **made_of})
        self._saved_s = self.running.clock()

    def _resume(self) -> None:
        """Take the last state up, if there is one. Raises RecipeError where another recipe or origin made it."""
        state = read_last(self.folder, self.running.tell)
        if state is None:
            return
        if Recipe.model_validate_json(state["recipe"]) != self.recipe:
            raise RecipeError(f"{self.folder} holds a run of another recipe: choose another --out")
        if state.get("origin", self.running.origin) != self.running.origin:  # an older run does not tell
            raise RecipeError(f"{self.folder} holds a run from other weights or of other objects: choose another --out")
        for name in ("module", "optimizer", "schedule"):
            getattr(self, name).load_state_dict(state[name])
        self.epoch, self.step, self.rows = state["epoch"], state["step"], state["rows"]
        self.total = state["total"].to(self.fabric.device)
