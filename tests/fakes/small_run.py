"""Training runs that take a moment: in this process, in a process that is killed, or in several
processes.
"""

import csv
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from lightning_fabric import Fabric
from nlos_models import CheckpointRecord
from nlos_models.training import Recipe, run_files
from nlos_models.training.loop import Running, fit
from nlos_models.training.recipe import recipe_of
from torch import Tensor, nn

SAMPLES = 24
BATCH = 4
STEPS = SAMPLES // BATCH

RIG = "paper-rig", "0123456789ab"
"""Name of a rig, and a checksum that is not its own."""


def small_recipe(**changes: object) -> Recipe:
    """Return a recipe of four epochs of six steps, with these changes."""
    facts = {
        "task": "vae",
        "objects": SAMPLES,
        "held_out": 4,
        "epochs": 4,
        "batch": BATCH,
        "learning_rate": 1e-2,
    }
    return recipe_of(facts | changes)


def small_record() -> CheckpointRecord:
    """Return the record of weights of that recipe."""
    return CheckpointRecord.of([small_recipe()], RIG)


def log_rows(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's log.csv without the column that depends on the clock."""
    with (folder / "log.csv").open(encoding="utf-8") as file:
        return [
            {key: value for key, value in row.items() if key != "seconds"}
            for row in csv.DictReader(file)
        ]


def state_of(module: nn.Module) -> dict[str, Tensor]:
    """Return a copy of a network's state."""
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def changed_tensors(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    """Return the names of the tensors that differ by any bit."""
    assert before.keys() == after.keys()
    return {name for name, tensor in before.items() if not torch.equal(tensor, after[name])}


class Stopped(Exception):  # noqa: N818  a stand-in for a fault
    """Fault that ends a run."""


class SmallRun:
    """Regression with noise and, unless `plain`, dropout and a batch norm: all state that resuming
    must restore.
    """

    def __init__(self, recipe: Recipe, folder: Path, *, plain: bool = False) -> None:
        torch.manual_seed(7)
        self.recipe = recipe
        self.folder = folder
        self.steps = list[tuple[int, int]]()
        self.scored = 0
        self.done = list[float]()
        """The share of the run that the loss was given at each step."""
        self.x = torch.rand(SAMPLES, 3)
        self.y = self.x.sum(1, keepdim=True)
        middle = [] if plain else [nn.BatchNorm1d(16), nn.Dropout(0.1)]
        self.noise = 0.0 if plain else 0.01
        self.net = nn.Sequential(nn.Linear(3, 16), *middle, nn.ReLU(), nn.Linear(16, 1))

    def _batches(self, generator: torch.Generator) -> Iterator[tuple[Tensor, Tensor]]:
        order = torch.randperm(SAMPLES, generator=generator)
        for index in order.split(self.recipe.batch):
            yield self.x[index], self.y[index]

    def _loss(self, batch: tuple[Tensor, Tensor], done: float) -> Tensor:
        self.done.append(done)
        x, y = batch
        return (self.net(x + self.noise * torch.randn(x.shape)) - y).square().mean()

    def score(self) -> dict[str, float]:
        """Return the held-out loss."""
        assert not self.net.training
        self.scored += 1
        with torch.inference_mode():
            return {"held_out_loss": (self.net(self.x) - self.y).square().mean().item()}

    def go(self, fail_at: int | None = None, **running: Any) -> dict[str, float]:
        """Train to the end, or to a fault at step `fail_at`."""

        def on_step(done: int, total: int) -> None:
            self.steps.append((done, total))
            if done == fail_at:
                raise Stopped

        return fit(
            self.net,
            recipe=self.recipe,
            steps_per_epoch=SAMPLES // self.recipe.batch,
            batches=self._batches,
            loss=self._loss,
            score=self.score,
            folder=self.folder,
            running=Running(on_step=on_step, **running),
        )

    @property
    def log(self) -> list[dict[str, str]]:
        """Rows of log.csv without the column that depends on the clock."""
        return log_rows(self.folder)


class Executioner:
    """Counter of the moments of a run; kills its process at one of them."""

    def __init__(self, moment: int | None = None) -> None:
        self.seen = 0
        self.moment = moment

    def __call__(self) -> None:
        """Count one more moment."""
        self.seen += 1
        if self.seen == self.moment:
            os.kill(os.getpid(), signal.SIGKILL)


def run_watched(recipe: Recipe, folder: Path, executioner: Executioner) -> SmallRun:
    """Train with a checkpoint after each step; moments are before a step, during a write and before
    a rename.
    """
    run = SmallRun(recipe, folder)
    fsync = os.fsync
    replace = Path.replace

    def watched_fsync(file: int) -> None:
        os.ftruncate(
            file, os.fstat(file).st_size // 2
        ) if executioner.seen + 1 == executioner.moment else None
        executioner()
        fsync(file)

    def watched_replace(path: Path, target: Path) -> Path:
        executioner()
        return replace(path, target)

    run_files.os.fsync = watched_fsync
    Path.replace = watched_replace  # type: ignore[method-assign]
    try:
        run.go(stop=lambda: bool(executioner()), checkpoint_s=0.0)
    finally:
        run_files.os.fsync = fsync
        Path.replace = replace  # type: ignore[method-assign]
    return run


def be_killed(recipe_json: str, folder: str, moment: int) -> None:
    """Run in a child process until it is killed at this moment."""
    torch.set_num_threads(1)
    run_watched(recipe_of(json.loads(recipe_json)), Path(folder), Executioner(moment))


def fail_in_one(fabric: Fabric, rank: int, error: Exception) -> None:
    """Run in each of two processes: fail in one of them, and wait for it in the other."""
    if fabric.global_rank == rank:
        raise error
    fabric.all_reduce(torch.ones(1))


def on_two(fabric: Fabric, folder: Path) -> dict[str, Any]:
    """Run in each of two processes: train once in one go, and once stopped by the other process and
    resumed.
    """
    recipe = small_recipe(epochs=3, schedule="one-cycle")
    whole = SmallRun(recipe, folder / "whole", plain=True)
    figures = whole.go(fabric=fabric)
    stopped = SmallRun(recipe, folder / "stopped", plain=True)
    messages = list[str]()
    try:
        stopped.go(fabric=fabric, stop=lambda: fabric.global_rank == 1, on_message=messages.append)
    except KeyboardInterrupt:
        messages.append("interrupted")
    again = SmallRun(recipe, folder / "stopped", plain=True)
    again.go(fabric=fabric)
    return {
        "figures": figures,
        "net": {name: tensor.tolist() for name, tensor in whole.net.state_dict().items()},
        "again": {name: tensor.tolist() for name, tensor in again.net.state_dict().items()},
        "messages": messages,
        "scored": float(fabric.all_reduce(torch.tensor(float(whole.scored)), reduce_op="sum")),
    }
