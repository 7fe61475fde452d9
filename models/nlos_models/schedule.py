"""How the learning rate falls over a run, and where its fall ends the run."""

from typing import Any

import torch

from nlos_models.recipe import Recipe

PLATEAU_FACTOR, PLATEAU_PATIENCE, SMALLEST_RATE = 0.3, 5, 1e-8
"""SI 3 and 4: the learning rate falls by this factor after this many epochs without progress, and ends the run."""
WARM_UP = 0.15
"""Of a one-cycle run: the share in which the rate rises."""


def schedule_of(recipe: Recipe, optimizer: torch.optim.Optimizer, steps: int) -> Any:
    """The recipe's schedule over so many steps: one-cycle is stepped at each, plateau at each epoch."""
    if recipe.schedule == "one-cycle":
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer, recipe.learning_rate, total_steps=steps, pct_start=WARM_UP, cycle_momentum=False
        )
    return torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimizer,
        factor=PLATEAU_FACTOR,
        patience=PLATEAU_PATIENCE,
        eps=0.0,  # torch's own would keep a rate of 1.4e-8 for ever, and the run with it
    )


def has_ended(recipe: Recipe, rate: float) -> bool:
    """Whether a plateau's rate is so small that the run is over; one-cycle ends with its last step."""
    return recipe.schedule == "plateau" and rate < SMALLEST_RATE
