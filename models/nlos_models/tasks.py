"""The two steps of the method as training tasks: first the VAE on images, then the compressor onto its latent."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nlos_models.compressor import Compressor
from nlos_models.data import Half, MapBatch, MapSet, image_batches, map_batches
from nlos_models.losses import image_error, kl_divergence, latent_error
from nlos_models.metrics import silhouette_iou
from nlos_models.pipeline import Pipeline
from nlos_models.preprocess import split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.res_vae import LATENT, ResVae
from nlos_models.silhouette import cut_silhouette
from nlos_models.train import OnStep, fit

SCORING_BATCH = 100


def train_vae(
    recipe: Recipe,
    images: Half,
    held_out: Half,
    folder: Path,
    on_step: OnStep,
) -> tuple[ResVae, dict[str, float]]:
    """Train a Res-VAE on images (n, 64, 64) in [0, 1] (SI 3); a second call resumes.

    Returns the network in eval mode and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    vae = ResVae().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] (torch's stub lacks it)

    def loss(image: Tensor) -> Tensor:
        image = image.contiguous(memory_format=torch.channels_last)
        rebuilt, mean, log_variance = vae(image, torch.randn(len(image), LATENT, device=image.device))
        return image_error(rebuilt, image) + recipe.kl_weight * kl_divergence(mean, log_variance)

    def score() -> dict[str, float]:
        return _figures(np.concatenate([_rebuild(vae, part) for part in _parts(held_out)]), held_out)

    fit(
        vae,
        recipe=recipe,
        steps_per_epoch=len(images) // recipe.batch,
        batches=lambda generator: image_batches(images, recipe.batch, generator),
        loss=loss,
        score=score,
        folder=folder,
        on_step=on_step,
    )
    return vae.eval(), score()


def train_compressor(
    recipe: Recipe,
    vae: ResVae,
    maps: MapSet,
    held_out: MapSet,
    folder: Path,
    on_step: OnStep,
) -> tuple[Pipeline, dict[str, float]]:
    """Train a compressor onto the latent of a trained, frozen VAE (SI 4); a second call resumes.

    Returns the network in eval mode and its held-out figures.
    """
    torch.manual_seed(recipe.seed)
    pipeline = Pipeline(Compressor(recipe.dropout), vae.decoder, recipe.left_noise)
    pipeline.preprocess.learn(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))
    pipeline = pipeline.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] (torch's stub lacks it)
    vae.requires_grad_(requires_grad=False).eval()

    targets = [_latents(vae, maps.image), _latents(vae, maps.image[:, ::-1])]  # as they are, and mirrored

    def loss(batch: MapBatch) -> Tensor:
        vae.eval()
        latent = pipeline.latent(batch.depth_m, batch.intensity)
        straight, mirrored = (pair[batch.row.cpu()].to(latent.device) for pair in targets)
        mean, log_variance = torch.where(batch.mirrored[:, None, None], mirrored, straight).unbind(1)
        value = recipe.latent_weight * latent_error(latent, mean, log_variance)
        if recipe.image_weight:
            value = value + recipe.image_weight * image_error(vae.decoder(latent), batch.image)
        return value

    def score() -> dict[str, float]:
        return _figures(run(pipeline, held_out), held_out.image)

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
def run(pipeline: Pipeline, maps: MapSet) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Images (n, 64, 64) that the pipeline makes of maps, in eval mode."""
    parts = [slice(k, k + SCORING_BATCH) for k in range(0, len(maps.image), SCORING_BATCH)]
    device = next(pipeline.parameters()).device
    depth, intensity = (torch.from_numpy(m).to(device) for m in (maps.depth_m, maps.intensity))
    return np.concatenate([pipeline(depth[part], intensity[part]).float().cpu().numpy() for part in parts])


@torch.no_grad()
def _latents(vae: ResVae, images: Half | np.ndarray) -> Tensor:  # pyright: ignore[reportMissingTypeArgument]
    """Mean and log-variance (n, 2, 256) of images (n, 64, 64)."""
    parts = (torch.from_numpy(part.astype(np.float32))[:, None] for part in _parts(images))
    return torch.cat([torch.stack(vae.encoder(part), dim=1) for part in parts])


def _parts(images: Half) -> list[Half]:
    return [images[k : k + SCORING_BATCH] for k in range(0, len(images), SCORING_BATCH)]


@torch.inference_mode()
def _rebuild(vae: ResVae, images: Half) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    device = next(vae.parameters()).device
    mean, _ = vae.encoder(torch.from_numpy(images.astype(np.float32)).to(device)[:, None])
    return cut_silhouette(vae.decoder(mean))[:, 0].float().cpu().numpy()


def _figures(image: np.ndarray[tuple[int, ...], np.dtype[np.float32]], truth: Half | np.ndarray) -> dict[str, float]:  # pyright: ignore[reportMissingTypeArgument]
    truth = truth.astype(np.float32)
    error = float(np.square(image - truth).sum((1, 2)).mean())
    return {"held_out_loss": error, "held_out_iou": float(np.mean(silhouette_iou(image, truth)))}
