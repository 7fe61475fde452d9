"""The two steps of the method as training tasks: first the VAE on images, then the compressor onto its latent."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nlos_models.arrays import Float16, Float32
from nlos_models.data import MapSet, as_images, image_batches
from nlos_models.errors import TrainingError
from nlos_models.losses import image_error, kl_divergence, variational_share
from nlos_models.networks import new_pipeline, new_vae
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import Recipe
from nlos_models.remap import Remapping, figures_of, in_channels_last, parts_of, set_for_training
from nlos_models.res_vae import ResVae
from nlos_models.silhouette import cut_silhouette
from nlos_models.sources import MapSource
from nlos_models.train import OnStep, Running, fit


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
    pipeline: Pipeline | None = None
    """Two-step weights, for steps "two-then-joint" (its decoder is the VAE's) or for a start from weights."""


def train_compressor(
    recipe: Recipe,
    start: Start,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    on_step: OnStep,
    running: Running | None = None,
) -> tuple[Pipeline, dict[str, float]]:
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


def _set_out(recipe: Recipe, start: Start) -> Pipeline:
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
