"""Training of an uncertainty network on a pipeline's images of ordinary objects, empty benches and
outliers, and its calibration: temperatures, error scale and thresholds, fitted on held-out maps.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from nlos_models.arrays import Float16, Float32, Float64, Mask
from nlos_models.training.data import flip_some, shuffled
from nlos_models.training.loop import Running, Scores, fit
from nlos_models.training.recipe import UncertaintyRecipe
from nlos_models.training.tasks import in_channels_last, parts_of
from nlos_models.uncertainty_network import (
    MAX_ERROR_V,
    MIN_ERROR_V,
    UncertaintyNetwork,
    UncertaintyOutput,
)


@dataclass(frozen=True)
class UncertaintySet:
    """Maps, the images that a pipeline reconstructed from them, and the ground truth."""

    depth_m: Float32
    """(n, 64, 80): NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80)."""
    made: Float16
    """(n, 64, 64): the pipeline's images."""
    truth: Float16
    """(n, 64, 64): 0 for background."""
    nothing: Mask
    """(n,): nothing is hidden."""
    outside: Mask
    """(n,): out of distribution: the object or its appearance is unlike the pipeline's training
    set.
    """

    def __len__(self) -> int:
        return len(self.nothing)

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "UncertaintySet":
        """Return the samples chosen by flags (n,) or by indices."""
        return UncertaintySet(**{name: values[chosen] for name, values in vars(self).items()})


class UncertaintyBatch(NamedTuple):
    """Batch of a `UncertaintySet` as float32 tensors."""

    depth_m: Tensor
    intensity: Tensor
    made: Tensor
    truth: Tensor
    nothing: Tensor
    outside: Tensor


def as_uncertainty_batch(some: UncertaintySet) -> UncertaintyBatch:
    """Return samples as float32 tensors."""
    maps = (some.depth_m, some.intensity)
    images = (some.made, some.truth)
    return UncertaintyBatch._make(
        torch.from_numpy(a.astype(np.float32)) for a in (*maps, *images, some.nothing, some.outside)
    )


def uncertainty_batches(
    samples: UncertaintySet, batch: int, generator: torch.Generator
) -> Iterator[UncertaintyBatch]:
    """Yield one epoch, shuffled and mirrored at random."""
    for index in shuffled(len(samples), batch, generator):
        chosen = as_uncertainty_batch(samples.where(index.numpy()))
        # Maps and both images are mirrored together; the verdicts are the same for a mirrored
        # frame.
        flips = torch.rand(len(index), generator=generator) < 0.5
        yield UncertaintyBatch._make([*flip_some(list(chosen[:4]), flips), *chosen[4:]])


def uncertainty_loss(output: UncertaintyOutput, batch: UncertaintyBatch) -> Tensor:
    """Return the cross-entropies of both verdicts and of the surface, plus the mean negative
    log-likelihood of errors.

    Errors count where image and truth both have a surface, as Laplace-distributed with scale b:
    -log p(e) is log b + e / b up to a constant, and its mean over e is least where b is the
    expected absolute error.
    """
    cross_entropy = functional.binary_cross_entropy_with_logits
    loss = cross_entropy(output.nothing, batch.nothing) + cross_entropy(
        output.outside, batch.outside
    )
    # Three cross-entropies, each a proper score: least where its probability is the share.
    there = (batch.truth > 0).float()  # (b, 64, 64)
    loss = loss + cross_entropy(output.surface, there)

    # Elsewhere an error of v is that of the silhouette, which the surface's probability tells.
    shared = (there > 0) & (batch.made > 0)
    error = (batch.made - batch.truth).abs()[shared]  # (pixels,)
    log_error = output.log_error.float()[shared].clamp(min=float(np.log(MIN_ERROR_V)))
    if not error.numel():
        return loss
    return loss + (log_error + error * torch.exp(-log_error)).mean()


@torch.inference_mode()
def predict(network: UncertaintyNetwork, samples: UncertaintySet) -> UncertaintyOutput:
    """Return the raw outputs of a network in eval mode for a whole set, on the CPU."""
    # Raw outputs, since the calibration fits divisors of logits.
    parts = parts_of(np.arange(len(samples)))
    device = next(network.parameters()).device
    outputs = [
        network(*(t.to(device) for t in as_uncertainty_batch(samples.where(part))[:3]))
        for part in parts
    ]
    return UncertaintyOutput(
        *(torch.cat(values).float().cpu() for values in zip(*outputs, strict=True))
    )


def train_uncertainty(
    recipe: UncertaintyRecipe,
    training: UncertaintySet,
    held_out: UncertaintySet,
    folder: Path,
    running: Running | None = None,
) -> tuple[UncertaintyNetwork, Scores]:
    """Train an uncertainty network; a second call resumes. Returns it in eval mode, and its
    held-out loss.
    """
    running = running or Running()
    torch.manual_seed(recipe.seed)
    network = UncertaintyNetwork()
    # The network sees differences from the bare wall, which it takes from the empty benches.
    bare = training.where(training.nothing)
    network.learn_bare(torch.from_numpy(bare.depth_m), torch.from_numpy(bare.intensity))
    network = in_channels_last(network)
    whole = as_uncertainty_batch(held_out)
    forward = running.maybe_compile(network)

    figures = fit(
        network,
        recipe=recipe,
        steps_per_epoch=len(training) // recipe.batch,
        batches=lambda generator: uncertainty_batches(training, recipe.batch, generator),
        loss=lambda batch, _: uncertainty_loss(forward(*batch[:3]), batch),
        score=lambda: {"held_out_loss": float(uncertainty_loss(predict(network, held_out), whole))},
        folder=folder,
        running=running,
    )
    return network.cpu().eval(), figures


TEMPERATURES = np.geomspace(1.0, 5.0, 65)
"""Candidates, from 1 up: for classes without overlap the likelihood grows down to a temperature of
0.
"""
MAX_FALSE_ALARMS = 0.15
"""Share of ordinary objects that may count as out of distribution, in exchange for finding nine in
ten that are.
"""
MAX_FALSE_OBJECTS = 0.001
"""Share of empty benches that may count as hiding an object: a tenth of the required limit."""


@dataclass(frozen=True)
class Calibration:
    """Fitted fields of `UncertaintyRecord`."""

    temperatures: tuple[float, float]
    error_scale: float
    nothing_above: float
    outside_above: float


def error_scale(expected: Float64, error: Float64) -> float:
    """Return the factor of expected errors b (n,) under which Laplace-distributed errors e (n,) are
    likeliest; 1 where no pixel has an error, since the images have no surface of the truths.

    The sum of log(f b) + e / (f b) is least at f = mean(e / b).
    """
    return float(np.mean(error / expected)) if error.size else 1.0


def temperature(logits: Float64, truth: Mask) -> float:
    """Return the divisor of logits (n,) under which the truth (n,) is likeliest."""
    x = torch.from_numpy(logits)
    y = torch.from_numpy(truth.astype(np.float64))
    # 65 candidates in place of an optimiser: one number, and no local minimum to be stuck in.
    losses = [float(functional.binary_cross_entropy_with_logits(x / t, y)) for t in TEMPERATURES]
    return float(TEMPERATURES[int(np.argmin(losses))])


def shared_errors(made: NDArray[np.floating], truth: NDArray[np.floating]) -> tuple[Mask, Float64]:
    """Return the mask of pixels with surface in images (n, 64, 64) and truths, and the errors of v
    there (pixels,).
    """
    # An error of depth is one of pixels that both call surface.
    shared = (made > 0) & (truth > 0)
    return shared, np.abs(made.astype(np.float64) - truth)[shared]


def calibrate(network: UncertaintyNetwork, held_out: UncertaintySet) -> Calibration:
    """Fit a network's error scale on ordinary objects, and its temperatures and thresholds on all
    samples.

    The set needs ordinary objects, outliers and empty benches.
    """
    # One divisor for all logits keeps their order, and makes the shares of a held-out set those
    # that the probabilities say (Guo et al. 2017, "On calibration of modern neural networks").
    output = predict(network, held_out)
    logits = (output.nothing.double(), output.outside.double())
    truths = (held_out.nothing, held_out.outside)
    temperatures = tuple(
        temperature(x.numpy(), truth) for x, truth in zip(logits, truths, strict=True)
    )
    nothing, outside = (_sigmoid(x.numpy() / t) for x, t in zip(logits, temperatures, strict=True))

    # The scale of expected errors, on ordinary objects alone: outliers have errors of their own.
    usual = ~held_out.nothing & ~held_out.outside
    shared, error = shared_errors(held_out.made[usual], held_out.truth[usual])
    expected = np.exp(output.log_error.numpy()[usual][shared].astype(np.float64)).clip(
        MIN_ERROR_V, MAX_ERROR_V
    )

    # Thresholds are quantiles of the held-out probabilities, so that they are shares of frames.
    return Calibration(
        (temperatures[0], temperatures[1]),
        error_scale(expected, error),
        min(0.5, float(np.quantile(nothing[held_out.nothing], MAX_FALSE_OBJECTS))),
        float(np.quantile(outside[usual], 1 - MAX_FALSE_ALARMS)),
    )


def _sigmoid(logits: Float64) -> Float64:
    return 1 / (1 + np.exp(-logits))
