"""Training a doubt network on what a pipeline made of ordinary objects, of empty benches and of outliers.

What makes a doubt network's words mean what they say: scales and thresholds, fitted on held-out maps.
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
from nlos_models.data import flip_some, shuffled
from nlos_models.doubt_network import MAX_ERROR_V, MIN_ERROR_V, DoubtNetwork, DoubtOutput
from nlos_models.recipe import Recipe
from nlos_models.tasks import in_channels_last, parts_of
from nlos_models.train import OnStep, Running, fit


@dataclass(frozen=True)
class DoubtSet:
    """Maps, what a pipeline made of them, and what was hidden."""

    depth_m: Float32
    """(n, 64, 80); NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80)."""
    made: Float16
    """(n, 64, 64); the pipeline's images."""
    truth: Float16
    """(n, 64, 64); 0 for background."""
    nothing: Mask
    """(n,); nothing is hidden."""
    outside: Mask
    """(n,); what is hidden, or how it is seen, is unlike what the pipeline was trained on."""

    def __len__(self) -> int:
        return len(self.nothing)

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "DoubtSet":
        """Those that are chosen, by flags (n,) or by their places."""
        return DoubtSet(**{name: values[chosen] for name, values in vars(self).items()})


class DoubtBatch(NamedTuple):
    """Some of a set, as tensors."""

    depth_m: Tensor
    intensity: Tensor
    made: Tensor
    truth: Tensor
    nothing: Tensor
    outside: Tensor


def as_doubt_batch(some: DoubtSet) -> DoubtBatch:
    """Samples as float32 tensors."""
    maps, images = (some.depth_m, some.intensity), (some.made, some.truth)
    return DoubtBatch._make(
        torch.from_numpy(a.astype(np.float32)) for a in (*maps, *images, some.nothing, some.outside)
    )


def doubt_batches(samples: DoubtSet, batch: int, generator: torch.Generator) -> Iterator[DoubtBatch]:
    """One epoch, shuffled and mirrored at random."""
    for index in shuffled(len(samples), batch, generator):
        chosen = as_doubt_batch(samples.where(index.numpy()))
        flips = torch.rand(len(index), generator=generator) < 0.5
        yield DoubtBatch._make([*flip_some(list(chosen[:4]), flips), *chosen[4:]])


def doubt_loss(said: DoubtOutput, batch: DoubtBatch) -> Tensor:
    """Of both verdicts, of where there is a surface, and of how far off it is.

    Where both the image and the truth have a surface, its error is taken to be of Laplace's distribution: the logarithm
    of its likelihood is greatest at the expected absolute error. Where nothing is hidden there is none.
    """
    verdicts = functional.binary_cross_entropy_with_logits
    loss = verdicts(said.nothing, batch.nothing) + verdicts(said.outside, batch.outside)
    there = (batch.truth > 0).float()
    loss = loss + verdicts(said.surface, there)
    shared = (there > 0) & (batch.made > 0)
    error = (batch.made - batch.truth).abs()[shared]
    log_error = said.log_error.float()[shared].clamp(min=float(np.log(MIN_ERROR_V)))
    if not error.numel():
        return loss
    return loss + (log_error + error * torch.exp(-log_error)).mean()


@torch.inference_mode()
def said_of(network: DoubtNetwork, samples: DoubtSet) -> DoubtOutput:
    """What a network in eval mode says of a whole set."""
    parts = parts_of(np.arange(len(samples)))
    device = next(network.parameters()).device
    said = [network(*(t.to(device) for t in as_doubt_batch(samples.where(part))[:3])) for part in parts]
    return DoubtOutput(*(torch.cat(values).float().cpu() for values in zip(*said, strict=True)))


def train_doubt(
    recipe: Recipe,
    training: DoubtSet,
    held_out: DoubtSet,
    folder: Path,
    on_step: OnStep,
    running: Running | None = None,
) -> tuple[DoubtNetwork, dict[str, float]]:
    """Train a doubt network; a second call resumes. Returns it in eval mode, and its held-out loss."""
    torch.manual_seed(recipe.seed)
    network = DoubtNetwork()
    bare = training.where(training.nothing)
    network.learn_bare(torch.from_numpy(bare.depth_m), torch.from_numpy(bare.intensity))
    network = in_channels_last(network)
    whole, quick = as_doubt_batch(held_out), (running or Running()).quick(network)

    def loss(batch: DoubtBatch, _: float) -> Tensor:
        return doubt_loss(quick(*batch[:3]), batch)

    figures = fit(
        network,
        recipe=recipe,
        steps_per_epoch=len(training) // recipe.batch,
        batches=lambda generator: doubt_batches(training, recipe.batch, generator),
        loss=loss,
        score=lambda: {"held_out_loss": float(doubt_loss(said_of(network, held_out), whole))},
        folder=folder,
        on_step=on_step,
        running=running,
    )
    return network.cpu().eval(), figures


TEMPERATURES = np.geomspace(1.0, 5.0, 65)
"""Never below 1: where all are told apart, the likeliest is 0, which says no more than that."""
MAX_FALSE_ALARMS = 0.15
"""Of ordinary objects, the share that may be told to be outside the trained range: what it costs to find nine in ten of
those that are."""
MAX_FALSE_OBJECTS = 0.001
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
    expected = np.exp(said.log_error.numpy()[usual][shared].astype(np.float64)).clip(MIN_ERROR_V, MAX_ERROR_V)
    return Calibration(
        hot,
        error_scale(expected, error),
        min(0.5, float(np.quantile(nothing[held_out.nothing], MAX_FALSE_OBJECTS))),
        float(np.quantile(outside[usual], 1 - MAX_FALSE_ALARMS)),
    )


def _sigmoid(logits: Float64) -> Float64:
    return 1 / (1 + np.exp(-logits))
