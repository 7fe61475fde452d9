"""The two steps of the method as training tasks: first the VAE on images, then the compressor onto its latent.

The second step of the method: maps onto a latent, and through a decoder; what training and transfer share.

Transfer to a real bench (SI 4): all layers of the compressor for a few epochs, then its last classifier alone.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import Tensor, nn

from nlos_models.arrays import Float16, Float32
from nlos_models.data import STATISTICS_OBJECTS, MapBatch, MapSet, MapSource, as_images, image_batches
from nlos_models.errors import TrainingError
from nlos_models.losses import image_error, kl_divergence, latent_error, variational_share
from nlos_models.metrics import colour_error, colour_silhouette_iou, silhouette_iou
from nlos_models.pipeline import (
    RemappingNetwork,
    channel_statistics,
    cut_silhouette,
    new_pipeline,
    new_vae,
    split_and_stack,
)
from nlos_models.recipe import Recipe
from nlos_models.train import OnStep, Running, fit
from nlos_models.vae import Encoder, ResVae

SCORING_BATCH = 100

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Remapping:
    """A pipeline that learns from maps, by the latents of a frozen encoder, by images, or by both."""

    pipeline: RemappingNetwork
    encoder: Encoder | None
    """Of the VAE whose latent is aimed at; None where only images are."""
    source: MapSource
    held_out: MapSet

    def learn_statistics(self, channels: slice = slice(None)) -> None:
        """Normalise maps, or some of the channels that they are split into, by those of the source."""
        mean, spread = statistics_of(self.source)
        self.pipeline.preprocess.mean[channels] = mean[channels]
        self.pipeline.preprocess.spread[channels] = spread[channels]

    def fit(
        self, recipe: Recipe, frozen: Iterable[nn.Module], folder: Path, on_step: OnStep, running: Running
    ) -> dict[str, float]:
        """Train all of the pipeline but its frozen parts; a second call resumes.

        A frozen part keeps its weights, and its batch norms their statistics: it works as it will when in use.
        """
        still, fabric = list(frozen), running.on(recipe)
        self.pipeline.requires_grad_(requires_grad=True)
        for part in still:
            part.requires_grad_(requires_grad=False)
        pipeline = in_channels_last(self.pipeline).to(fabric.device)
        targets = self._targets(recipe, fabric)
        latent_of, decoded = running.quick(pipeline.latent), running.quick(pipeline.decoder)

        def loss(batch: MapBatch, _: float) -> Tensor:
            for part in still:
                part.eval()
            latent = latent_of(batch.depth_m, batch.intensity)
            value = torch.zeros((), device=latent.device)
            if targets:
                straight, mirrored = (pair[batch.row] for pair in targets)
                aim = torch.where(batch.mirrored[:, None, None], mirrored, straight)
                value = value + recipe.latent_weight * latent_error(latent, *aim.unbind(1))
            if recipe.image_weight:
                error = image_error(decoded(latent), batch.image, recipe.surface_weight, recipe.image_loss)
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
            on_step=on_step,
            running=running,
        )

    def _targets(self, recipe: Recipe, fabric: Fabric) -> list[Tensor]:
        """The latents (n, 2, latent) of the images as they are, and of their mirrors; none where none are aimed at."""
        if not recipe.latent_weight:
            return []
        if self.encoder is None:
            raise TrainingError("these weights have no encoder to aim at: set latent_weight = 0, or name a VAE's")
        encoder = in_channels_last(self.encoder).to(fabric.device).requires_grad_(requires_grad=False).eval()
        with fabric.autocast():
            return [
                latents_of(encoder, images).float() for images in (self.source.image, self.source.image[..., ::-1, :])
            ]


def in_channels_last(module: Module) -> Module:
    """The module with its convolutions' weights laid out as CPUs and GPUs are fastest with."""
    return module.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] (torch's stub lacks it)


def set_for_training(pipeline: RemappingNetwork, recipe: Recipe) -> None:
    """Give a loaded pipeline the recipe's dropout and noise, which weights do not hold."""
    pipeline.preprocess.left_noise = recipe.left_noise
    for module in pipeline.compressor.modules():
        if isinstance(module, nn.Dropout):
            module.p = recipe.dropout


def statistics_of(source: MapSource) -> tuple[Tensor, Tensor]:
    """Mean and spread, each (channels,), of the channels that a source's maps are split into."""
    maps = source.first(STATISTICS_OBJECTS)
    return channel_statistics(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))


@torch.inference_mode()
def run(pipeline: RemappingNetwork, maps: MapSet) -> Float32:
    """Images (n, 64, 64) that the pipeline makes of maps, in eval mode; in colour (n, 3, 64, 64)."""
    device = next(pipeline.parameters()).device
    pairs = zip(parts_of(maps.depth_m), parts_of(maps.intensity), strict=True)
    made = (pipeline(*(torch.from_numpy(part).to(device) for part in pair)) for pair in pairs)
    return np.concatenate([images.float().cpu().numpy() for images in made])


@torch.no_grad()
def latents_of(encoder: Encoder, images: Float16 | Float32) -> Tensor:
    """Mean and log-variance (n, 2, latent) of images (n, 64, 64) or in colour, where the encoder is."""
    device = next(encoder.parameters()).device
    parts = (as_images(part).to(device) for part in parts_of(images))
    return torch.cat([torch.stack(encoder(part), dim=1) for part in parts])


def parts_of(arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Arrays (n, ...) in parts that a network takes at once without learning from them."""
    return [arrays[k : k + SCORING_BATCH] for k in range(0, len(arrays), SCORING_BATCH)]


def figures_of(image: Float32, truth: Float16 | Float32) -> dict[str, float]:
    """What a run is judged by: squared error, summed over pixels, and silhouette IoU, averaged over (n, 64, 64).

    Of images in colour (n, 3, 64, 64) also the error of colour: 1 where none shares a pixel with its truth.
    """
    truth = truth.astype(np.float32)
    error = float(np.square(image - truth).sum(tuple(range(1, truth.ndim))).mean())
    if truth.ndim == 3:
        return {"held_out_loss": error, "held_out_iou": float(np.mean(silhouette_iou(image, truth)))}
    colour = colour_error(image, truth)
    seen = colour[~np.isnan(colour)]
    figures = {"held_out_loss": error, "held_out_iou": float(np.mean(colour_silhouette_iou(image, truth)))}
    return {**figures, "held_out_colour_error": float(seen.mean()) if seen.size else 1.0}


def train_vae(
    recipe: Recipe,
    images: Float16,
    held_out: Float16,
    folder: Path,
    on_step: OnStep,
    running: Running | None = None,
    start: ResVae | None = None,
) -> tuple[ResVae, dict[str, float]]:
    """Train a Res-VAE on images (n, 64, 64), or in colour (n, 3, 64, 64), in [0, 1] (SI 3); a second call resumes.

    It sets out from `start` if there is one. Returns the network in eval mode and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    vae = in_channels_last(start or new_vae(colour=recipe.colour))
    quick = (running or Running()).quick(vae)

    def loss(image: Tensor, done: float) -> Tensor:
        if recipe.augmentation == "turns":
            image = turn_some(image, torch.randint(4, (len(image),), device=image.device))
        image = image.contiguous(memory_format=torch.channels_last)
        share = variational_share(done, recipe.latent_warm_up)
        noise = share * torch.randn(len(image), vae.latent, device=image.device)
        rebuilt, mean, log_variance = quick(image, noise)
        error = image_error(rebuilt, image, recipe.surface_weight, recipe.image_loss)
        return error + share * recipe.kl_weight * kl_divergence(mean, log_variance)

    figures = fit(
        vae,
        recipe=recipe,
        steps_per_epoch=len(images) // recipe.batch,
        batches=lambda generator: image_batches(images, recipe.batch, generator),
        loss=loss,
        score=lambda: figures_of(rebuilt(vae, held_out), held_out),
        folder=folder,
        on_step=on_step,
        running=running,
    )
    return vae.cpu().eval(), figures


@dataclass(frozen=True)
class Start:
    """What a compressor's training sets out from."""

    vae: ResVae | None = None
    """Whose latent is aimed at, and whose decoder is used; None for steps "one"."""
    pipeline: RemappingNetwork | None = None
    """Two-step weights, for steps "two-then-joint" (its decoder is the VAE's) or for a start from weights."""


def train_compressor(
    recipe: Recipe,
    start: Start,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    on_step: OnStep,
    running: Running | None = None,
) -> tuple[RemappingNetwork, dict[str, float]]:
    """Train a compressor as the recipe's `steps` say (SI 4: onto the latent of a frozen VAE); a second call resumes.

    Returns the network in eval mode and its held-out figures. Raises TrainingError where the start does not hold what
    these steps need.
    """
    torch.manual_seed(recipe.seed)
    pipeline = _set_out(recipe, start)
    remapping = Remapping(pipeline, start.vae.encoder if start.vae else None, maps, held_out)
    if recipe.steps != "two-then-joint":
        remapping.learn_statistics()
    frozen = [pipeline.decoder] if recipe.steps == "two" else []
    figures = remapping.fit(recipe, frozen, folder, on_step, running or Running())
    return pipeline.cpu().eval(), figures


def _set_out(recipe: Recipe, start: Start) -> RemappingNetwork:
    if recipe.steps == "one":
        return new_pipeline(
            colour=recipe.colour, dropout=recipe.dropout, left_noise=recipe.left_noise, width=recipe.width
        )
    if recipe.steps == "two-then-joint":
        if start.pipeline is None:
            raise TrainingError("steps 'two-then-joint' go on from two-step weights: name them (--weights)")
        set_for_training(start.pipeline, recipe)
        return start.pipeline
    if start.vae is None:
        raise TrainingError("steps 'two' need a trained VAE: name one (--vae)")
    pipeline = start.pipeline or new_pipeline(start.vae.decoder, colour=recipe.colour, width=recipe.width)
    pipeline.decoder = start.vae.decoder
    set_for_training(pipeline, recipe)
    return pipeline


def turn_some(images: Tensor, quarters: Tensor) -> Tensor:
    """Turn each of images (n, channels, 64, 64) by so many quarters (n,); with the mirror, SI 3's turns and flips."""
    turned = torch.stack([images.rot90(k, (-2, -1)) for k in range(4)])
    return turned[quarters, torch.arange(len(images), device=images.device)]


@torch.inference_mode()
def rebuilt(vae: ResVae, images: Float16 | Float32) -> Float32:
    """What a VAE alone makes of images (n, 64, 64) or (n, 3, 64, 64), cut as the pipeline cuts."""
    device = next(vae.parameters()).device
    means = (vae.encoder(as_images(part).to(device))[0] for part in parts_of(images))
    made = np.concatenate([cut_silhouette(vae.decoder(mean)).float().cpu().numpy() for mean in means])
    return made.reshape(images.shape)


ALL_LAYERS, CLASSIFIER = "all-layers", "classifier"
"""Each phase's folder in the run's."""
CHANNELS = {"own": slice(None), "own intensity": slice(2, None)}
"""Which channels take the recordings' statistics; depth is in metres on every bench, intensity in a device's counts."""


def train_transfer(
    recipe: Recipe,
    pipeline: RemappingNetwork,
    encoder: Encoder | None,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    on_step: OnStep,
    running: Running | None = None,
) -> tuple[RemappingNetwork, dict[str, float]]:
    """Train synthetic weights on, in place, on recordings' maps; a second call resumes. The decoder stays as it is.

    In the first phase batch norms go over to the recordings' statistics; in the second they are frozen with the
    features, so that nothing but the classifier changes. Returns the network in eval mode and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    running = running or Running()
    set_for_training(pipeline, recipe)
    remapping = Remapping(pipeline, encoder, maps, held_out)
    if recipe.statistics != "kept":
        remapping.learn_statistics(CHANNELS[recipe.statistics])
    steps = len(maps.image) // recipe.batch
    before = recipe.all_layers_epochs * steps
    total = before + recipe.epochs * steps
    if recipe.all_layers_epochs:
        first = recipe.model_copy(update={"epochs": recipe.all_layers_epochs})
        remapping.fit(first, [pipeline.decoder], folder / ALL_LAYERS, lambda done, _: on_step(done, total), running)
    frozen = [pipeline.decoder, pipeline.compressor.get_submodule("features")]
    figures = remapping.fit(recipe, frozen, folder / CLASSIFIER, lambda done, _: on_step(before + done, total), running)
    return pipeline.cpu().eval(), figures
