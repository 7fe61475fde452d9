"""What makes a doubt network's words mean what they say: scales and thresholds, fitted on held-out maps."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from nlos_models.arrays import Float64, Mask
from nlos_models.doubt_network import LEAST_ERROR_V, MOST_ERROR_V, DoubtNetwork
from nlos_models.doubt_training import DoubtSet, said_of

TEMPERATURES = np.geomspace(1.0, 5.0, 65)
"""Never below 1: where all are told apart, the likeliest is 0, which says no more than that."""
MOST_FALSE_ALARMS = 0.15
"""Of ordinary objects, the share that may be told to be outside the trained range: what it costs to find nine in ten of
those that are."""
MOST_FALSE_OBJECTS = 0.001
"""Of empty benches, the share that may be told to hide something: a tenth of what is asked for."""


@dataclass(frozen=True)
class Calibration:
    """What `DoubtRecord` keeps of it."""

    temperatures: tuple[float, float]
    error_scale: float
    nothing_above: float
    outside_above: float


def error_scale(expected: Float64, error: Float64) -> float:
    """What expected errors (n,) are to be multiplied by, so that errors (n,) are likeliest: Laplace's one answer."""
    return float(np.mean(error / expected))


def temperature(logits: Float64, truth: Mask) -> float:
    """What logits (n,) are to be divided by, so that the truth (n,) is likeliest."""
    x, y = torch.from_numpy(logits), torch.from_numpy(truth.astype(np.float64))
    losses = [float(functional.binary_cross_entropy_with_logits(x / t, y)) for t in TEMPERATURES]
    return float(TEMPERATURES[int(np.argmin(losses))])


def shared_errors(made: NDArray[np.floating], truth: NDArray[np.floating]) -> tuple[Mask, Float64]:
    """Where images (n, 64, 64) and truths both have a surface, and by how much v is off there (pixels,)."""
    shared = (made > 0) & (truth > 0)
    return shared, np.abs(made.astype(np.float64) - truth)[shared]


def calibrated(network: DoubtNetwork, held_out: DoubtSet) -> Calibration:
    """A network's calibration: errors by ordinary objects, verdicts by all.

    The set needs objects of each sort: ordinary, outside, and none.
    """
    said, logits = said_of(network, held_out), dict[str, Float64]()
    for name in ("nothing", "outside"):
        logits[name] = getattr(said, name).double().numpy()
    hot = temperature(logits["nothing"], held_out.nothing), temperature(logits["outside"], held_out.outside)
    nothing, outside = (_sigmoid(logits[name] / t) for name, t in zip(("nothing", "outside"), hot, strict=True))
    usual = ~held_out.nothing & ~held_out.outside
    shared, error = shared_errors(held_out.made[usual], held_out.truth[usual])
    expected = np.exp(said.log_error.numpy()[usual][shared].astype(np.float64)).clip(LEAST_ERROR_V, MOST_ERROR_V)
    return Calibration(
        hot,
        error_scale(expected, error),
        min(0.5, float(np.quantile(nothing[held_out.nothing], MOST_FALSE_OBJECTS))),
        float(np.quantile(outside[usual], 1 - MOST_FALSE_ALARMS)),
    )


def _sigmoid(logits: Float64) -> Float64:
    return 1 / (1 + np.exp(-logits))
