"""Training a doubt network on what a pipeline made of ordinary objects, of empty benches and of outliers."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from nlos_models.arrays import Float16, Float32, Mask
from nlos_models.data import flip_some, shuffled
from nlos_models.doubt_network import LEAST_ERROR_V, DoubtNetwork, DoubtOutput
from nlos_models.recipe import Recipe
from nlos_models.remap import in_channels_last, parts_of
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
    log_error = said.log_error.float()[shared].clamp(min=float(np.log(LEAST_ERROR_V)))
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
