"""Training of the direct network, and its transfer to a bench: noise drawn at each step, two
heads.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from nlos_models.direct import CLIP, COLUMNS, ROWS, CellNormal, DirectNetwork
from nlos_models.training.data import STATISTICS_OBJECTS, MapBatch, MapNoise, MapSet, MapSource
from nlos_models.training.loop import Running, Scores, fit
from nlos_models.training.losses import two_heads_error
from nlos_models.training.recipe import DirectRecipe, TransferRecipe
from nlos_models.training.tasks import figures_of, in_two_phases, run

STAINS = 9, 11
"""Knots of a wall's stains along each axis of the maps."""


class NormalBatch(NamedTuple):
    """Batch of normalised maps with the images of the hidden objects."""

    normal: Tensor
    """(b, 2, 64, 80), or in color (b, 4, 64, 80), float16."""
    image: Tensor
    """(b, 64, 64), or in color (b, 3, 64, 64), float16."""
    log_counts: Tensor | None = None
    """(b, 64, 80), float16: log(1 + intensity) on the bench itself, of maps that are aligned with
    another rig; its light decides the noise. None where the maps' own does."""


class NormalSource(Protocol):
    """Training maps, normalised and stored once; objects may be added while a run goes on."""

    normal: CellNormal
    noise: MapNoise | None
    """Noise to draw at each step, of expected maps; None for maps that have theirs."""

    def batches(self, batch: int, generator: torch.Generator) -> Iterable[NormalBatch]:
        """Return all objects that are there, shuffled; the same generator returns the same ones
        again.
        """
        ...


def train_direct(
    recipe: DirectRecipe,
    source: NormalSource,
    held_out: MapSet,
    folder: Path,
    running: Running | None = None,
    start: DirectNetwork | None = None,
) -> tuple[DirectNetwork, Scores]:
    """Train a direct network, from scratch or on from another's weights; a second call resumes.

    The source's normalisation becomes the network's. Where the recipe has more blocks or mixers, the new ones
    change nothing at first. Returns the network in eval mode, with the recipe's blend of both, and
    its held-out figures.
    """
    # Initial weights follow from the recipe's seed; `fit` seeds each step by itself.
    torch.manual_seed(recipe.seed)
    network = DirectNetwork(recipe.direct, recipe.dropout, color=recipe.colour)
    if start:
        # Not strict: blocks and mixers that only this recipe has stay as they are initialised,
        # that is, as identities.
        network.load_state_dict(start.state_dict(), strict=False)
    # After the start weights, which may be another rig's: the maps are normalised by the source.
    network.normal.load_state_dict(source.normal.state_dict())
    steps = recipe.objects // recipe.batch

    def batches(generator: torch.Generator) -> Iterable[NormalBatch]:
        return repeat(source, recipe.batch, steps, generator)

    running = running or Running()
    # The normalisation is outside: it is exact in float32, and `source` has done it.
    logits = running.maybe_compile(network.logits)

    def loss(batch: NormalBatch, _: float) -> Tensor:
        return step_error(recipe, network.normal, logits, batch, source.noise)

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
    # After the last step, so that the run itself is the same at any blend.
    if start and recipe.blend < 1:
        blend(network, start, recipe.blend)
        figures = figures_of(run(network.eval(), held_out), held_out.image)
    return network.cpu().eval(), figures


def blend(network: DirectNetwork, start: DirectNetwork, share: float) -> None:
    """Replace a network's parameters by means with another's, of which its own have a share; new
    layers stay.
    """
    # Weights on both ends of a fine-tuning lie in one basin of the loss, so that their mean is good
    # on the old maps and on the new ones.
    theirs = dict(start.named_parameters())
    with torch.no_grad():
        for name, own in network.named_parameters():
            if name in theirs:
                own.lerp_(theirs[name].to(own.device), 1 - share)


def transfer_direct(
    recipe: TransferRecipe,
    network: DirectNetwork,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    running: Running | None = None,
) -> tuple[DirectNetwork, Scores]:
    """Fine-tune a direct network in place on recordings' maps: all layers, then the heads; a second
    call resumes.

    Returns it in eval mode, and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    for block in network.trunk:
        # A checkpoint does not hold its dropout, which is a setting of the training.
        block.dropout.p = recipe.dropout  # type: ignore[union-attr]  (a Residual)
    if recipe.statistics != "kept":
        seen = maps.first(STATISTICS_OBJECTS)
        # Depth is in metres on every bench, intensity in the counts of a device: the latter may
        # be taken alone.
        channels = slice(1, None) if recipe.statistics == "own intensity" else slice(None)
        device = network.normal.median.device
        depth_m, intensity = (
            torch.from_numpy(values).to(device) for values in (seen.depth_m, seen.intensity)
        )
        network.normal.shift(depth_m, intensity, channels)

    def loss(batch: MapBatch, _: float) -> Tensor:
        normal = network.normal(batch.depth_m, batch.intensity)
        return two_heads_error(
            network.logits(normal + recipe.noise * torch.randn_like(normal)), batch.image[:, 0]
        )

    def fit_phase(
        phase: TransferRecipe, phase_folder: Path, running: Running, *, last_layers: bool
    ) -> Scores:
        # The heads and the norm before them are 1 % of the weights: what few recordings can
        # teach.
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


def step_error(
    recipe: DirectRecipe,
    cells: CellNormal,
    logits: Callable[[Tensor], Tensor],
    batch: NormalBatch,
    noise: MapNoise | None,
) -> Tensor:
    """Return the loss of a training step: of a batch's maps as another bench or moment would give
    them.
    """
    # Maps are rendered once, without noise; each step draws its own, so that none is learnt.
    normal = varied(recipe, cells, batch, noise)
    return two_heads_error(logits(normal + recipe.noise * torch.randn_like(normal)), batch.image)


def varied(
    recipe: DirectRecipe, cells: CellNormal, batch: NormalBatch, noise: MapNoise | None
) -> Tensor:
    """Return a batch's normalised maps (n, 2, 64, 80) with noise, and on walls and with range
    offsets as the recipe has them.
    """
    normal = batch.normal.float()
    reflectance = offset_m = None
    if recipe.wall_texture:
        # Every strength from none to the recipe's: a network must be right on a clean wall too.
        strength = recipe.wall_texture * torch.rand(len(normal), 1, 1, device=normal.device)
        reflectance = strength * _stains(len(normal), normal.device)
    if recipe.range_offset_m:
        offset_m = recipe.range_offset_m * torch.randn(len(normal), device=normal.device)
    # Nothing to vary: the round trip through counts would only round.
    if noise is None and reflectance is None and offset_m is None:
        return normal
    # The logarithm fits into float16 at any number of counts, which the counts do not.
    own = None if batch.log_counts is None else torch.expm1(batch.log_counts.float())
    return vary(cells, normal, noise, reflectance, offset_m, own)


def vary(
    cells: CellNormal,
    normal: Tensor,
    noise: MapNoise | None,
    log_reflectance: Tensor | None,
    offset_m: Tensor | None,
    own_counts: Tensor | None = None,
) -> Tensor:
    """Return the maps (n, 2, 64, 80), normalised as `cells` does, as another bench or moment would
    give them.

    Noise is the sensor's, drawn for the intensity of expected maps; the logarithm of the wall's
    reflectance (n, 64, 80) adds to that of the light, and a range offset (n,) to all depths.
    `own_counts` (n, 64, 80) are the intensities behind aligned maps.
    """
    depth = normal[:, :1]  # (n, 1, 64, 80)
    light = normal[:, 1:]  # (n, 1 or 3, 64, 80)
    returns = (normal != 0).any(dim=1, keepdim=True)

    # Noise and reflectance act on counts, so that the normalisation (a logarithm) is undone.
    median = cells.median[1:]
    spread = cells.spread[1:]
    # A cell that is clipped far below its median would have a negative light, and no logarithm.
    counts = torch.expm1(light * spread + median).clamp(min=0)
    if log_reflectance is not None:
        counts = counts * log_reflectance.exp()[:, None]
    if noise is not None:
        counts = noise.add(counts, behind=own_counts)
    if offset_m is not None:
        depth = depth + offset_m[:, None, None, None] / cells.spread[:1]

    varied = torch.cat([depth, (torch.log1p(counts) - median) / spread], dim=1)
    return torch.where(returns, varied.clamp(-CLIP, CLIP), normal)


def _stains(count: int, device: torch.device) -> Tensor:
    """Return patterns (count, 64, 80) of mean 0 and variance 1: half stains of some cells, half
    grain.
    """
    # The sum of two independent patterns of variance 1 has variance 2.
    coarse = torch.randn(count, 1, *STAINS, device=device)
    stains = functional.interpolate(coarse, (ROWS, COLUMNS), mode="bilinear", align_corners=True)[
        :, 0
    ]
    stains = stains / stains.std((1, 2), keepdim=True)
    return (stains + torch.randn_like(stains)) * 0.5**0.5


def repeat(
    source: NormalSource, batch: int, steps: int, generator: torch.Generator
) -> Iterable[NormalBatch]:
    """Yield `steps` batches; where the objects run out they come again in another order."""
    while steps:
        for one in source.batches(batch, generator):
            yield one
            steps -= 1
            if not steps:
                return
