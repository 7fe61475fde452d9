"""Transfer to a real bench (SI 4): all layers of the compressor for a few epochs, then its last classifier alone."""

from pathlib import Path

import torch

from nlos_models.data import MapSet
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import Recipe
from nlos_models.remap import Remapping, set_for_training
from nlos_models.res_vae import Encoder
from nlos_models.sources import MapSource
from nlos_models.train import OnStep, Running

ALL_LAYERS, CLASSIFIER = "all-layers", "classifier"
"""Each phase's folder in the run's."""
CHANNELS = {"own": slice(None), "own intensity": slice(2, None)}
"""Which channels take the recordings' statistics; depth is in metres on every bench, intensity in a device's counts."""


def train_transfer(
    recipe: Recipe,
    pipeline: Pipeline,
    encoder: Encoder | None,
    maps: MapSource,
    held_out: MapSet,
    folder: Path,
    on_step: OnStep,
    running: Running | None = None,
) -> tuple[Pipeline, dict[str, float]]:
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
