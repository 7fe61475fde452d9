"""The two steps of training in colour (simulation only): the VAE on albedo images, then ResNet50 onto its latent."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlos_models.colour import LATENT, colour_pipeline, colour_vae
from nlos_models.colour_metrics import colour_metrics
from nlos_models.data import Half, MapBatch, MapSet, image_batches, map_batches
from nlos_models.losses import image_error, kl_divergence, latent_error
from nlos_models.pipeline import Pipeline
from nlos_models.preprocess import split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.remap import parts_of
from nlos_models.res_vae import ResVae
from nlos_models.silhouette import cut_silhouette
from nlos_models.train import OnStep, fit

Float32 = NDArray[np.float32]


def train_colour_vae(
    recipe: Recipe, images: Half, held_out: Half, folder: Path, on_step: OnStep
) -> tuple[ResVae, dict[str, float]]:
    """Train a Res-VAE on colour images (n, 3, 64, 64) in [0, 1] (SI 3); a second call resumes.

    Returns the network in eval mode and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    vae = colour_vae().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] (torch's stub lacks it)

    def loss(image: Tensor) -> Tensor:
        image = image.contiguous(memory_format=torch.channels_last)
        noise = torch.randn(len(image), LATENT, device=image.device)
        rebuilt, mean, log_variance = vae(image, noise)
        return image_error(rebuilt, image) + recipe.kl_weight * kl_divergence(mean, log_variance)

    def score() -> dict[str, float]:
        return _figures(rebuild(vae, held_out), held_out)

    fit(
        vae,
        recipe=recipe,
        steps_per_epoch=len(images) // recipe.batch,
        batches=lambda generator: (batch[:, 0] for batch in image_batches(images, recipe.batch, generator)),
        loss=loss,
        score=score,
        folder=folder,
        on_step=on_step,
    )
    return vae.eval(), score()


def train_colour_compressor(
    recipe: Recipe, vae: ResVae, maps: MapSet, held_out: MapSet, folder: Path, on_step: OnStep
) -> tuple[Pipeline, dict[str, float]]:
    """Train a ResNet50 onto the latent of a trained, frozen colour VAE (SI 4); a second call resumes.

    The sets hold intensities (n, 3, 64, 80) and images (n, 3, 64, 64). Returns the network in eval mode and its
    held-out figures.
    """
    torch.manual_seed(recipe.seed)
    pipeline = colour_pipeline(vae.decoder, recipe.dropout, recipe.left_noise)
    pipeline.preprocess.learn(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))
    pipeline = pipeline.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] (torch's stub lacks it)
    vae.requires_grad_(requires_grad=False).eval()
    targets = [_latents(vae, maps.image), _latents(vae, maps.image[:, :, ::-1])]  # as they are, and mirrored

    def loss(batch: MapBatch) -> Tensor:
        vae.eval()
        latent = pipeline.latent(batch.depth_m, batch.intensity)
        straight, mirrored = (pair[batch.row.cpu()].to(latent.device) for pair in targets)
        mean, log_variance = torch.where(batch.mirrored[:, None, None], mirrored, straight).unbind(1)
        value = recipe.latent_weight * latent_error(latent, mean, log_variance)
        if recipe.image_weight:
            value = value + recipe.image_weight * image_error(vae.decoder(latent), batch.image[:, 0])
        return value

    def score() -> dict[str, float]:
        return _figures(run_colour(pipeline, held_out), held_out.image)

    fit(
        pipeline,
        recipe=recipe,
        steps_per_epoch=len(maps.image) // recipe.batch,
        batches=lambda generator: map_batches(maps, recipe.batch, generator),
        loss=loss,
        score=score,
        folder=folder,
        on_step=on_step,
    )
    return pipeline.eval(), score()


@torch.inference_mode()
def run_colour(pipeline: Pipeline, maps: MapSet) -> Float32:
    """Colour images (n, 3, 64, 64) that the pipeline makes of maps, in eval mode."""
    device = next(pipeline.parameters()).device
    pairs = zip(parts_of(maps.depth_m), parts_of(maps.intensity), strict=True)
    made = [pipeline(*(torch.from_numpy(part).to(device) for part in pair)) for pair in pairs]
    return torch.cat(made).float().cpu().numpy()


@torch.inference_mode()
def rebuild(vae: ResVae, images: Half | Float32) -> Float32:
    """What the VAE alone makes of colour images (n, 3, 64, 64), cut as the pipeline cuts."""
    device = next(vae.parameters()).device
    means = (vae.encoder(torch.from_numpy(part.astype(np.float32)).to(device))[0] for part in parts_of(images))
    return torch.cat([cut_silhouette(vae.decoder(mean)) for mean in means]).float().cpu().numpy()


@torch.no_grad()
def _latents(vae: ResVae, images: Half | Float32) -> Tensor:
    """Mean and log-variance (n, 2, latent) of colour images."""
    parts = (torch.from_numpy(part.astype(np.float32)) for part in parts_of(images))
    return torch.cat([torch.stack(vae.encoder(part), dim=1) for part in parts])


def _figures(image: Float32, truth: Half | Float32) -> dict[str, float]:
    truth = truth.astype(np.float32)
    error = float(np.square(image - truth).sum((1, 2, 3)).mean())
    values = colour_metrics(image, truth)
    seen = values["colour_error"][~np.isnan(values["colour_error"])]
    figures = {"held_out_iou": float(values["silhouette_iou"].mean())}
    return {"held_out_loss": error, **figures, "held_out_colour_error": float(seen.mean()) if seen.size else 1.0}
