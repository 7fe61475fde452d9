"""The second step of the method: maps onto a latent, and through a decoder; what training and transfer share."""

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
from nlos_models.colour_metrics import colour_error, colour_silhouette_iou
from nlos_models.data import MapBatch, MapSet, as_images
from nlos_models.errors import TrainingError
from nlos_models.losses import image_error, latent_error
from nlos_models.metrics import silhouette_iou
from nlos_models.pipeline import Pipeline
from nlos_models.preprocess import channel_statistics, split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.res_vae import Encoder
from nlos_models.sources import STATISTICS_OBJECTS, MapSource
from nlos_models.train import OnStep, Running, fit

SCORING_BATCH = 100

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Remapping:
    """A pipeline that learns from maps, by the latents of a frozen encoder, by images, or by both."""

    pipeline: Pipeline
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


def set_for_training(pipeline: Pipeline, recipe: Recipe) -> None:
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
def run(pipeline: Pipeline, maps: MapSet) -> Float32:
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
