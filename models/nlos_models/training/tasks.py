"""Training tasks of the method: VAE on images, compressor onto the VAE's latent, and transfer to a
bench (SI 3, 4).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import Tensor, nn

from nlos_models.arrays import Float16, Float32
from nlos_models.errors import TrainingError
from nlos_models.metrics import color_error, color_silhouette_iou, silhouette_iou
from nlos_models.pipeline import (
    RemappingNetwork,
    cut_silhouette,
    new_pipeline,
    new_vae,
    split_and_stack,
)
from nlos_models.training.data import (
    STATISTICS_OBJECTS,
    MapBatch,
    MapSet,
    MapSource,
    as_images,
    image_batches,
)
from nlos_models.training.loop import Running, Scores, fit
from nlos_models.training.losses import image_error, kl_divergence, latent_error, variational_share
from nlos_models.training.recipe import CompressorRecipe, MapRecipe, TransferRecipe, VaeRecipe
from nlos_models.vae import Encoder, ResVae

SCORING_BATCH = 100
ALL_LAYERS = "all-layers"
CLASSIFIER = "classifier"
PHASES = ALL_LAYERS, CLASSIFIER
"""Folders of a transfer's two phases."""
CHANNELS = {"own": slice(None), "own intensity": slice(2, None)}
"""Channels that take the recordings' statistics: depth is in metres on every bench, intensity in a
device's counts.
"""

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Remapping:
    """A pipeline with the maps that it is trained on, by the latents of a frozen encoder, by
    images, or by both.
    """

    pipeline: RemappingNetwork
    encoder: Encoder | None
    """Of the VAE whose latents are the targets; None for a loss of images alone."""
    source: MapSource
    held_out: MapSet

    def learn_statistics(self, channels: slice = slice(None)) -> None:
        """Normalise some or all channels of the split maps by the source's mean and spread."""
        # A sample of the maps: all of them may not fit into memory.
        maps = self.source.first(STATISTICS_OBJECTS)
        stacked = split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity))
        self.pipeline.preprocess.learn(stacked, channels)

    def fit(
        self, recipe: MapRecipe, frozen: Iterable[nn.Module], folder: Path, running: Running
    ) -> Scores:
        """Train all of the pipeline except its frozen parts; a second call resumes.

        Frozen parts keep their weights and run in eval mode, so that their batch norms keep their
        statistics too.
        """
        frozen_parts = list(frozen)
        # Everything trains except what is named: a resumed run, or a second phase, may have left
        # other flags.
        fabric = running.fabric_for(recipe)
        self.pipeline.requires_grad_(requires_grad=True)
        for part in frozen_parts:
            part.requires_grad_(requires_grad=False)
        pipeline = in_channels_last(self.pipeline).to(fabric.device)
        targets = self._targets(recipe, fabric)
        encode = running.maybe_compile(pipeline.latent)
        decode = running.maybe_compile(pipeline.decoder)

        def loss(batch: MapBatch, _: float) -> Tensor:
            # `fit` has set the whole module to train. A frozen batch norm in that mode would go on
            # adapting its statistics, and the decoder would no longer be the VAE's.
            for part in frozen_parts:
                part.eval()
            latent = encode(batch.depth_m, batch.intensity)  # (b, 256)
            value = torch.zeros((), device=latent.device)

            # The latent loss alone is SI 4's idea. It does not know which directions of the latent
            # change the image, so that our recipes add the image behind the frozen decoder.
            if targets:
                straight, mirrored = (pair[batch.row] for pair in targets)
                target = torch.where(batch.mirrored[:, None, None], mirrored, straight)
                value = value + recipe.latent_weight * latent_error(latent, *target.unbind(1))
            if recipe.image_weight:
                error = image_error(
                    decode(latent), batch.image, recipe.surface_weight, recipe.image_loss
                )
                value = value + recipe.image_weight * error
            return value

        return fit(
            pipeline,
            recipe=recipe,
            steps_per_epoch=len(self.source.image) // recipe.batch,
            batches=lambda generator: self.source.batches(recipe.batch, generator),
            loss=loss,
            score=lambda: figures_of(run(pipeline, self.held_out), self.held_out.image),
            folder=folder,
            running=running,
        )

    def _targets(self, recipe: MapRecipe, fabric: Fabric) -> list[Tensor]:
        """Return the latents (n, 2, latent) of the images and of their mirror images; none without
        a latent loss.
        """
        if not recipe.latent_weight:
            return []
        if self.encoder is None:
            raise TrainingError(
                "these weights have no encoder to aim at: set latent_weight = 0, or name a VAE"
                " (--vae); that of the paper's weights is made again by `nlos-cam train vae"
                " --recipe vae-encoder --out DIR`"
            )
        encoder = (
            in_channels_last(self.encoder)
            .to(fabric.device)
            .requires_grad_(requires_grad=False)
            .eval()
        )
        # Both orientations once, in place of an encoder's pass at every step; a mirrored object has
        # its own latent, since the encoder is not symmetric.
        with fabric.autocast():
            return [
                latents_of(encoder, images).float()
                for images in (self.source.image, self.source.image[..., ::-1, :])
            ]


def in_channels_last(module: Module) -> Module:
    """Return the module with its convolutions' weights in the layout that CPUs and GPUs run
    fastest.
    """
    # A convolution then reads all channels of a pixel from one place.
    # torch's stub omits this argument.
    return module.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def set_for_training(pipeline: RemappingNetwork, recipe: MapRecipe) -> None:
    """Give a loaded pipeline the recipe's dropout and noise, which checkpoints do not hold."""
    # Noise and dropout are settings of a training, not weights.
    pipeline.preprocess.left_noise = recipe.left_noise
    for module in pipeline.compressor.modules():
        if isinstance(module, nn.Dropout):
            module.p = recipe.dropout


@torch.inference_mode()
def run(pipeline: nn.Module, maps: MapSet) -> Float32:
    """Return the images (n, 64, 64), in color (n, 3, 64, 64), that a pipeline in eval mode
    reconstructs from maps.
    """
    # Batches of 100: the activations of all held-out maps at once take gigabytes.
    device = next(pipeline.parameters()).device
    pairs = zip(parts_of(maps.depth_m), parts_of(maps.intensity), strict=True)
    parts = (pipeline(*(torch.from_numpy(part).to(device) for part in pair)) for pair in pairs)
    return np.concatenate([images.float().cpu().numpy() for images in parts])


@torch.no_grad()
def latents_of(encoder: Encoder, images: Float16 | Float32) -> Tensor:
    """Return mean and log-variance (n, 2, latent) of images (n, 64, 64) or (n, 3, 64, 64), on the
    encoder's device.
    """
    device = next(encoder.parameters()).device
    parts = (as_images(part).to(device) for part in parts_of(images))
    return torch.cat([torch.stack(encoder(part), dim=1) for part in parts])


def parts_of(arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Split arrays (n, ...) into batches for inference."""
    return [arrays[k : k + SCORING_BATCH] for k in range(0, len(arrays), SCORING_BATCH)]


def figures_of(image: Float32, truth: Float16 | Float32) -> Scores:
    """Return the squared error, summed over pixels, and silhouette IoU, averaged over images (n,
    64, 64).

    For color images (n, 3, 64, 64) also the color error: 1 if no object shares a pixel with its
    ground truth.
    """
    truth = truth.astype(np.float32)
    # Squared in any case, so that runs with different losses have one scale to be compared on.
    error = float(np.square(image - truth).sum(tuple(range(1, truth.ndim))).mean())
    if truth.ndim == 3:
        return {
            "held_out_loss": error,
            "held_out_iou": float(np.mean(silhouette_iou(image, truth))),
        }
    # Objects without a shared pixel have no color error; if none has one, the worst.
    color = color_error(image, truth)
    shared = color[~np.isnan(color)]
    figures = {
        "held_out_loss": error,
        "held_out_iou": float(np.mean(color_silhouette_iou(image, truth))),
    }
    return {**figures, "held_out_colour_error": float(shared.mean()) if shared.size else 1.0}


def train_vae(
    recipe: VaeRecipe,
    images: Float16,
    held_out: Float16,
    folder: Path,
    running: Running | None = None,
    start: ResVae | None = None,
) -> tuple[ResVae, Scores]:
    """Train a Res-VAE (SI 3), from `start` if given, on images (n, 64, 64) or (n, 3, 64, 64) in [0,
    1].

    A second call resumes. Returns the network in eval mode and its held-out figures.
    """
    # Initial weights follow from the recipe's seed; `fit` seeds each step by itself.
    torch.manual_seed(recipe.seed)
    running = running or Running()
    vae = in_channels_last(start or new_vae(color=recipe.colour))
    forward = running.maybe_compile(vae)
    trains_decoder = recipe.start != "decoder"
    vae.decoder.requires_grad_(trains_decoder)

    def loss(image: Tensor, done: float) -> Tensor:
        # A decoder that stays keeps the statistics of its batch norms too.
        vae.decoder.train(trains_decoder)
        if recipe.augmentation == "turns":
            image = turn_some(image, torch.randint(4, (len(image),), device=image.device))
        image = image.contiguous(memory_format=torch.channels_last)

        # (b, 1, 64, 64) -> mean and log-variance (b, 256) -> one draw of the latent -> image: the
        # evidence lower bound with one sample (Kingma and Welling 2013), its two terms weighted.
        share = variational_share(done, recipe.latent_warm_up)
        noise = share * torch.randn(len(image), vae.latent, device=image.device)
        decoded, mean, log_variance = forward(image, noise)
        error = image_error(decoded, image, recipe.surface_weight, recipe.image_loss)
        return error + share * recipe.kl_weight * kl_divergence(mean, log_variance)

    figures = fit(
        vae,
        recipe=recipe,
        steps_per_epoch=len(images) // recipe.batch,
        batches=lambda generator: image_batches(images, recipe.batch, generator),
        loss=loss,
        score=lambda: figures_of(rebuild(vae, held_out), held_out),
        folder=folder,
        running=running,
    )
    return vae.cpu().eval(), figures


@dataclass(frozen=True)
class Start:
    """Networks that a compressor's training starts from."""

    vae: ResVae | None = None
    """Source of the target latents and of the decoder; None for steps = "one"."""
    pipeline: RemappingNetwork | None = None
    """Two-step weights, for steps = "two-then-joint" (its decoder is the VAE's) or start =
    "weights".
    """


def train_compressor(
    recipe: CompressorRecipe,
    start: Start,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    running: Running | None = None,
) -> tuple[RemappingNetwork, Scores]:
    """Train a compressor by the recipe's `steps` (SI 4: onto the latent of a frozen VAE); a second
    call resumes.

    Returns the pipeline in eval mode and its held-out figures. Raises TrainingError where these
    steps need a network that `start` does not hold.
    """
    torch.manual_seed(recipe.seed)
    pipeline = _starting_pipeline(recipe, start)
    # Two steps: the decoder is the VAE's and stays. One step, or jointly: it trains too, and the
    # latent is no longer the VAE's.
    remapping = Remapping(pipeline, start.vae.encoder if start.vae else None, maps, held_out)
    # Two-step weights bring their statistics: other ones would shift every input of the compressor.
    if recipe.steps != "two-then-joint":
        remapping.learn_statistics()
    frozen = [pipeline.decoder] if recipe.steps == "two" else []
    figures = remapping.fit(recipe, frozen, folder, running or Running())
    return pipeline.cpu().eval(), figures


def _starting_pipeline(recipe: CompressorRecipe, start: Start) -> RemappingNetwork:
    if recipe.steps == "one":
        return new_pipeline(
            color=recipe.colour,
            dropout=recipe.dropout,
            left_noise=recipe.left_noise,
            width=recipe.width,
        )
    if recipe.steps == "two-then-joint":
        if start.pipeline is None:
            raise TrainingError(
                "steps = 'two-then-joint' starts from two-step weights: name them (--weights)"
            )
        pipeline = start.pipeline
    else:
        if start.vae is None:
            raise TrainingError("steps = 'two' needs a trained VAE: name one (--vae)")
        pipeline = start.pipeline or new_pipeline(
            start.vae.decoder, color=recipe.colour, width=recipe.width
        )
        pipeline.decoder = start.vae.decoder
    set_for_training(pipeline, recipe)
    return pipeline


def turn_some(images: Tensor, quarters: Tensor) -> Tensor:
    """Rotate images (n, channels, 64, 64) by quarter turns (n,); with the mirror, these are SI 3's
    turns and flips.
    """
    # All four turns of all images, then one of each: no loop over samples.
    turned = torch.stack([images.rot90(k, (-2, -1)) for k in range(4)])
    return turned[quarters, torch.arange(len(images), device=images.device)]


@torch.inference_mode()
def rebuild(vae: ResVae, images: Float16 | Float32) -> Float32:
    """Return images (n, 64, 64) or (n, 3, 64, 64) encoded and decoded by a VAE, with the pipeline's
    silhouette cut.
    """
    device = next(vae.parameters()).device
    # The mean, not a draw: the most likely image of a latent.
    means = (vae.encoder(as_images(part).to(device))[0] for part in parts_of(images))
    decoded = np.concatenate(
        [cut_silhouette(vae.decoder(mean)).float().cpu().numpy() for mean in means]
    )
    return decoded.reshape(images.shape)


def train_transfer(
    recipe: TransferRecipe,
    pipeline: RemappingNetwork,
    encoder: Encoder | None,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    running: Running | None = None,
) -> tuple[RemappingNetwork, Scores]:
    """Fine-tune a pipeline in place on recordings' maps (SI 4); the decoder stays as it is. A
    second call resumes.

    The first phase trains all layers of the compressor, and batch norms take the recordings'
    statistics; the second freezes these with the features and trains the classifier alone. Returns
    the pipeline in eval mode and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    set_for_training(pipeline, recipe)
    remapping = Remapping(pipeline, encoder, maps, held_out)
    if recipe.statistics != "kept":
        remapping.learn_statistics(CHANNELS[recipe.statistics])

    def fit_phase(
        phase: TransferRecipe, phase_folder: Path, running: Running, *, last_layers: bool
    ) -> Scores:
        # SI 4: the features, with their batch norms, are frozen in the second phase.
        features = [pipeline.compressor.get_submodule("features")] if last_layers else []
        return remapping.fit(phase, [pipeline.decoder, *features], phase_folder, running)

    figures = in_two_phases(recipe, len(maps.image), folder, running or Running(), fit_phase)
    return pipeline.cpu().eval(), figures


class FitPhase(Protocol):
    """Training of one phase of a transfer: of all layers, or of the last ones alone."""

    def __call__(
        self, phase: TransferRecipe, phase_folder: Path, running: Running, *, last_layers: bool
    ) -> Scores: ...


def in_two_phases(
    recipe: TransferRecipe, samples: int, folder: Path, running: Running, fit_phase: FitPhase
) -> Scores:
    """Train all layers for `all_layers_epochs`, then the last ones (SI 4); return the last phase's
    figures.
    """
    # A few epochs let all layers adapt to the bench's statistics. Then only the last ones go on:
    # recordings are few, and would be learnt by heart by all layers.
    steps = samples // recipe.batch
    before = recipe.all_layers_epochs * steps
    total = before + recipe.epochs * steps

    def counting_from(first: int) -> Running:
        def on_step(done: int, _: int) -> None:
            running.on_step(first + done, total)

        return replace(running, on_step=on_step)

    if recipe.all_layers_epochs:
        first = recipe.model_copy(update={"epochs": recipe.all_layers_epochs})
        fit_phase(first, folder / ALL_LAYERS, counting_from(0), last_layers=False)
    return fit_phase(recipe, folder / CLASSIFIER, counting_from(before), last_layers=True)
