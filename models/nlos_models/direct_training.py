"""Training of the direct network, and its transfer to a bench: noise drawn at each step, two heads."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from nlos_models.data import STATISTICS_OBJECTS, MapBatch, MapSet, MapSource
from nlos_models.direct import CellNormal, DirectNetwork, MapNoise, two_heads_error
from nlos_models.recipe import Recipe
from nlos_models.tasks import figures_of, in_two_phases, run
from nlos_models.train import Running, Scores, fit


class NormalBatch(NamedTuple):
    """Batch of normalised maps with the images of the hidden objects."""

    normal: Tensor
    """(b, 2, 64, 80), float16."""
    image: Tensor
    """(b, 64, 64), float16."""


class NormalSource(Protocol):
    """Training maps, normalised and stored once; objects may be added while a run goes on."""

    normal: CellNormal
    noise: MapNoise | None
    """Noise to draw at each step, of expected maps; None for maps that have theirs."""

    def batches(self, batch: int, generator: torch.Generator) -> Iterable[NormalBatch]:
        """Return all objects that are there, shuffled; the same generator returns the same ones again."""
        ...


def train_direct(
    recipe: Recipe, source: NormalSource, held_out: MapSet, folder: Path, running: Running | None = None
) -> tuple[DirectNetwork, Scores]:
    """Train a direct network; a second call resumes. Returns it in eval mode, and its held-out figures."""
    torch.manual_seed(recipe.seed)
    network = DirectNetwork(recipe.direct, recipe.dropout)
    network.normal.load_state_dict(source.normal.state_dict())
    steps = recipe.objects // recipe.batch

    def batches(generator: torch.Generator) -> Iterable[NormalBatch]:
        return repeat(source, recipe.batch, steps, generator)

    running = running or Running()
    logits = running.maybe_compile(network.logits)

    def loss(batch: NormalBatch, _: float) -> Tensor:
        normal = batch.normal.float()
        if source.noise:
            normal = network.normal.add_noise(normal, source.noise)
        return two_heads_error(logits(normal + recipe.noise * torch.randn_like(normal)), batch.image)

    figures = fit(
        network,
        recipe=recipe,
        steps_per_epoch=steps,
        batches=batches,
        loss=loss,
        score=lambda: figures_of(run(network, held_out), held_out.image),
        folder=folder,
        running=running,
    )
    return network.cpu().eval(), figures


def transfer_direct(
    recipe: Recipe,
    network: DirectNetwork,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    running: Running | None = None,
) -> tuple[DirectNetwork, Scores]:
    """Fine-tune a direct network in place on recordings' maps: all layers, then the heads; a second call resumes.

    Returns it in eval mode, and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    for block in network.trunk:
        block.dropout.p = recipe.dropout  # type: ignore[union-attr]  (a Residual)
    if recipe.statistics != "kept":
        seen = maps.first(STATISTICS_OBJECTS)
        channels = slice(1, None) if recipe.statistics == "own intensity" else slice(None)
        network.normal.shift(torch.from_numpy(seen.depth_m), torch.from_numpy(seen.intensity), channels)

    def loss(batch: MapBatch, _: float) -> Tensor:
        normal = network.normal(batch.depth_m, batch.intensity)
        return two_heads_error(network.logits(normal + recipe.noise * torch.randn_like(normal)), batch.image[:, 0])

    def fit_phase(phase: Recipe, phase_folder: Path, running: Running, *, last_layers: bool) -> Scores:
        network.requires_grad_(not last_layers)
        for layer in network.last_layers:
            layer.requires_grad_(requires_grad=True)
        return fit(
            network,
            recipe=phase,
            steps_per_epoch=len(maps.image) // phase.batch,
            batches=lambda generator: maps.batches(phase.batch, generator),
            loss=loss,
            score=lambda: figures_of(run(network, held_out), held_out.image),
            folder=phase_folder,
            running=running,
        )

    figures = in_two_phases(recipe, len(maps.image), folder, running or Running(), fit_phase)
    return network.cpu().eval(), figures


def repeat(source: NormalSource, batch: int, steps: int, generator: torch.Generator) -> Iterable[NormalBatch]:
    """Yield `steps` batches; where the objects run out they come again in another order."""
    while steps:
        for one in source.batches(batch, generator):
            yield one
            steps -= 1
            if not steps:
                return
