"""The training loop on a network small enough to train in a moment: stop anywhere, resume, same bits."""

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from nlos_models import train
from nlos_models.recipe import Recipe
from nlos_models.train import fit
from torch import Tensor, nn

SAMPLES, BATCH = 24, 4
STEPS = SAMPLES // BATCH


class Stopped(Exception):  # noqa: N818  a stand-in for Ctrl-C
    """Someone pulled the plug."""


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _recipe(**changes: object) -> Recipe:
    facts = {"task": "vae", "objects": SAMPLES, "held_out": 4, "epochs": 4, "batch": BATCH, "learning_rate": 1e-2}
    return Recipe.model_validate(facts | changes)


class Run:
    """A small regression with dropout and noise: everything that a resumed run could get wrong."""

    def __init__(self, recipe: Recipe, folder: Path) -> None:
        torch.manual_seed(7)
        self.recipe, self.folder, self.steps = recipe, folder, []
        self.x, self.scored = torch.rand(SAMPLES, 3), 0
        self.y = self.x.sum(1, keepdim=True)
        self.net = nn.Sequential(nn.Linear(3, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Dropout(0.1), nn.Linear(16, 1))

    def _batches(self, generator: torch.Generator) -> Iterator[tuple[Tensor, Tensor]]:
        order = torch.randperm(SAMPLES, generator=generator)
        for k in range(STEPS):
            index = order[k * BATCH : (k + 1) * BATCH]
            yield self.x[index], self.y[index]

    def _loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        x, y = batch
        return (self.net(x + 0.01 * torch.randn(x.shape)) - y).square().mean()

    def _score(self) -> dict[str, float]:
        assert not self.net.training
        with torch.inference_mode():
            self.scored += 1
            return {"held_out_loss": (self.net(self.x) - self.y).square().mean().item()}

    def go(self, stop_at: int | None = None) -> "Run":
        def on_step(done: int, total: int) -> None:
            self.steps.append((done, total))
            if done == stop_at:
                raise Stopped

        fit(
            self.net,
            recipe=self.recipe,
            steps_per_epoch=STEPS,
            batches=self._batches,
            loss=self._loss,
            score=self._score,
            folder=self.folder,
            on_step=on_step,
        )
        return self

    @property
    def log(self) -> list[dict[str, str]]:
        with (self.folder / "log.csv").open(encoding="utf-8") as file:
            return [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


def _assert_same(one: Run, other: Run) -> None:
    for (name, mine), its in zip(one.net.state_dict().items(), other.net.state_dict().values(), strict=True):
        assert torch.equal(mine, its), name
    assert one.log == other.log


@pytest.mark.parametrize("schedule", ["one-cycle", "plateau"])
@pytest.mark.parametrize("stop_at", [1, STEPS, STEPS + 2, 3 * STEPS])
def test_a_stopped_and_resumed_run_equals_an_uninterrupted_one(tmp_path: Path, schedule: str, stop_at: int) -> None:
    recipe = _recipe(schedule=schedule)
    whole = Run(recipe, tmp_path / "whole").go()
    with pytest.raises(Stopped):
        Run(recipe, tmp_path / "stopped").go(stop_at)
    torch.manual_seed(99)
    _assert_same(Run(recipe, tmp_path / "stopped").go(), whole)


def test_the_seed_decides_the_run(tmp_path: Path) -> None:
    first, again = (Run(_recipe(), tmp_path / name).go() for name in ("first", "again"))
    _assert_same(first, again)
    other = Run(_recipe(seed=1), tmp_path / "other").go()
    assert other.log != first.log


def test_the_loss_falls(tmp_path: Path) -> None:
    log = Run(_recipe(epochs=10), tmp_path).go().log
    assert [int(row["epoch"]) for row in log] == list(range(10))
    assert float(log[-1]["held_out_loss"]) < 0.5 * float(log[0]["held_out_loss"])


def test_progress_counts_every_step_to_the_end(tmp_path: Path) -> None:
    run = Run(_recipe(), tmp_path).go()
    assert run.steps == [(k + 1, 4 * STEPS) for k in range(4 * STEPS)]


def test_progress_of_a_resumed_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    with pytest.raises(Stopped):
        Run(_recipe(), tmp_path).go(STEPS + 2)
    assert Run(_recipe(), tmp_path).go().steps[0] == (STEPS + 1, 4 * STEPS)


def test_a_finished_run_does_not_train_again(tmp_path: Path) -> None:
    Run(_recipe(), tmp_path).go()
    assert Run(_recipe(), tmp_path).go().steps == []


def test_a_run_whose_learning_rate_reached_its_end_stops_and_does_not_train_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "PLATEAU_PATIENCE", 0)
    monkeypatch.setattr(train, "SMALLEST_RATE", 2e-3)
    monkeypatch.setattr(Run, "_score", lambda _: {"held_out_loss": 1.0})
    done = Run(_recipe(epochs=20), tmp_path).go().steps
    assert 2 * STEPS <= len(done) <= 5 * STEPS  # the rate falls to 1e-2, 3e-3 and 9e-4
    assert Run(_recipe(epochs=20), tmp_path).go().steps == []


def test_frozen_parameters_stay(tmp_path: Path) -> None:
    run = Run(_recipe(), tmp_path)
    frozen = run.net[0].weight.requires_grad_(requires_grad=False)
    before, free = frozen.clone(), run.net[4].weight.detach().clone()
    run.go()
    assert torch.equal(frozen, before)
    assert not torch.equal(run.net[4].weight, free)


def test_bfloat16_trains_too(tmp_path: Path) -> None:
    log = Run(_recipe(precision="bf16-mixed", epochs=8), tmp_path).go().log
    assert float(log[-1]["held_out_loss"]) < float(log[0]["held_out_loss"])
