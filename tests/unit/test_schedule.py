"""How the rate falls: a plateau's to its end from anywhere, one-cycle's up and down over its steps."""

import pytest
import torch
from nlos_models.recipe import PLATEAU_PATIENCE, SMALLEST_RATE, Recipe, has_ended, schedule_of
from torch import nn


def _recipe(schedule: str, rate: float) -> Recipe:
    facts = {"task": "vae", "objects": 4, "held_out": 1, "epochs": 1, "batch": 2}
    return Recipe.model_validate(facts | {"schedule": schedule, "learning_rate": rate})


def _optimizer(rate: float) -> torch.optim.Optimizer:
    return torch.optim.SGD([nn.Parameter(torch.zeros(1))], rate)


@pytest.mark.parametrize("rate", [1e-2, 2e-3, 1e-3, 1.3e-8])
def test_without_progress_a_plateau_ends_from_any_rate(rate: float) -> None:
    recipe, optimizer = _recipe("plateau", rate), _optimizer(rate)
    schedule, rates = schedule_of(recipe, optimizer, 1), [rate]
    while not has_ended(recipe, rates[-1]):
        assert len(rates) < 100
        schedule.step(1.0)
        rates.append(optimizer.param_groups[0]["lr"])
    assert rates[-2] >= SMALLEST_RATE > rates[-1]
    assert rates[1 : PLATEAU_PATIENCE + 2] == [rate] * (PLATEAU_PATIENCE + 1)
    assert rates[PLATEAU_PATIENCE + 2 :][:1] in ([], [pytest.approx(0.3 * rate)])


def test_one_cycle_rises_to_the_recipes_rate_falls_to_next_to_nothing_and_is_ended_by_its_steps_alone() -> None:
    recipe, optimizer = _recipe("one-cycle", 1e-3), _optimizer(1e-3)
    schedule, rates = schedule_of(recipe, optimizer, 101), list[float]()
    for _ in range(100):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    peak = rates.index(max(rates))
    assert max(rates) == pytest.approx(1e-3, rel=1e-2)
    assert rates == sorted(rates[: peak + 1]) + sorted(rates[peak + 1 :], reverse=True)
    assert optimizer.param_groups[0]["lr"] < SMALLEST_RATE
    assert not has_ended(recipe, 0.0)
