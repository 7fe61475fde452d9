"""Schedules of the learning rate."""

import math
from typing import Any

import torch

from nlos_models.training.recipe import Recipe

PLATEAU_FACTOR = 0.3
PLATEAU_PATIENCE = 5
SMALLEST_RATE = 1e-8
"""SI 3 and 4: factor of the learning rate after this many epochs without progress; a smaller rate
ends the run.
"""
SMALLEST_SHARE = 0.01
"""Share of the rate that a cosine schedule ends with."""
WARM_UP = 0.15
"""Share of a one-cycle run in which the rate rises."""


def schedule_of(recipe: Recipe, optimizer: torch.optim.Optimizer, steps: int) -> Any:
    """Return the recipe's schedule: one-cycle or cosine over `steps`, stepped at each, or plateau,
    at each epoch.
    """
    if recipe.schedule == "one-cycle":
        # Our default where the budget is fixed: a high peak rate explores, and the long decay to
        # almost 0 settles within the budget, however short it is (Smith and Topin 2017). The
        # momentum stays, since Adam's betas are the recipe's.
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            recipe.learning_rate,
            total_steps=steps,
            pct_start=WARM_UP,
            cycle_momentum=False,
        )
    if recipe.schedule == "cosine":
        # The direct network's: Adam's second moments are unreliable in the first steps, so that
        # the rate rises linearly; half a cosine then needs no choice of when to step down.
        warm_up = min(recipe.warm_up_steps, steps // 2)

        def share(step: int) -> float:
            if step < warm_up:
                return (step + 1) / warm_up
            through = min(1.0, (step - warm_up) / max(1, steps - warm_up))
            return SMALLEST_SHARE + (1 - SMALLEST_SHARE) * (1 + math.cos(math.pi * through)) / 2

        return torch.optim.lr_scheduler.LambdaLR(optimizer, share)

    # The paper's (SI 3 and 4), which names a final rate in place of a number of epochs.
    return torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimizer,
        factor=PLATEAU_FACTOR,
        patience=PLATEAU_PATIENCE,
        eps=0.0,  # torch's default would keep the rate at 1.4e-8, and the run would not end
    )


def has_ended(recipe: Recipe, rate: float) -> bool:
    """Return True once a plateau's rate has fallen below SMALLEST_RATE; one-cycle ends with its
    last step.
    """
    return recipe.schedule == "plateau" and rate < SMALLEST_RATE
