"""What a run of `train` sets out from: weights named or shipped, and the runs that made them."""

from pathlib import Path

import torch
from nlos_models.checkpoint import (
    load_encoder,
    load_pipeline,
    load_pipeline_partly,
    load_record,
    load_vae,
    shipped_folder,
)
from nlos_models.networks import new_vae
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import SIMULATION_ONLY, Recipe
from nlos_models.record import CheckpointRecord
from nlos_models.res_vae import ResVae
from nlos_models.tasks import Start

from nlos_cam.cli.common import say
from nlos_cam.errors import SceneError


def vae_start(recipe: Recipe, weights: Path | None) -> tuple[ResVae, list[Recipe]]:
    """A VAE of the recipe's kind to go on from, and the runs that made it; the shipped one unless named."""
    _same_colour(recipe, weights)
    trained, record = load_vae(weights or shipped_folder())
    return trained, record.vae_runs


def compressor_start(recipe: Recipe, vae_folder: Path | None, weights: Path | None) -> tuple[Start, list[Recipe]]:
    """What the recipe's steps set out from, and the runs that made it; none where they set out from nothing."""
    if recipe.steps == "one":
        return Start(), []
    if recipe.steps == "two":
        trained, of_vae = vae_start(recipe, vae_folder)
        if recipe.start == "scratch":
            return Start(trained), of_vae
        pipeline, runs = _pipeline_start(recipe, weights)
        return Start(trained, pipeline), [*(run for run in runs if run not in of_vae), *of_vae]
    pipeline, runs = _pipeline_start(recipe, weights)
    trained = new_vae(colour=recipe.colour)
    if encoder := load_encoder(weights):
        trained.encoder = encoder
    elif recipe.latent_weight:
        raise SceneError(f"{weights} has no encoder to aim at: set latent_weight = 0 in the recipe")
    trained.decoder = pipeline.decoder
    return Start(trained, pipeline), runs


def _pipeline_start(recipe: Recipe, weights: Path | None) -> tuple[Pipeline, list[Recipe]]:
    _fits(recipe, weights)
    pipeline, record = load_pipeline(weights)
    return pipeline, record.runs


def transfer_start(recipe: Recipe, weights: Path | None, *, partial: bool) -> tuple[Pipeline, list[Recipe]]:
    """What a transfer sets out from, and the runs that made it.

    In part, only what fits is taken; the rest is as the recipe's seed has it.
    """
    _fits(recipe, weights)
    torch.manual_seed(recipe.seed)
    if partial:
        pipeline, record, report = load_pipeline_partly(weights or shipped_folder())
        say(f"compressor: {report}")
    else:
        pipeline, record = load_pipeline(weights)
    return pipeline, record.runs


def _fits(recipe: Recipe, folder: Path | None) -> None:
    record = _same_colour(recipe, folder)
    if record.input != recipe.maps:
        raise SceneError(f"these weights eat {record.input}, the recipe says {recipe.maps}: change one of them")
    if recipe.task == "compressor" and record.width != recipe.width:
        raise SceneError(
            f"these weights are {record.width:g} wide, the recipe says {recipe.width:g}: change one of them"
        )


def _same_colour(recipe: Recipe, folder: Path | None) -> CheckpointRecord:
    """The record of weights that are, as the recipe is, of depth or in colour: networks of the two do not fit."""
    record = load_record(folder or shipped_folder())
    if record.colour != recipe.colour:
        holds, wants = (f"in colour ({SIMULATION_ONLY})" if one.colour else "of depth" for one in (record, recipe))
        raise SceneError(
            f"{folder or 'what is shipped'} holds weights {holds}, the recipe is {wants}: name others with --vae or "
            "--weights"
        )
    return record
