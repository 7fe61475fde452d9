"""Training in colour as the commands run it: recipe in, checkpoint folder out (simulation only, see `colour_data`)."""

from pathlib import Path

from nlos_calibration.rig import Rig
from nlos_models.checkpoint import CheckpointRecord, load_vae, save_pipeline, save_vae
from nlos_models.colour_tasks import train_colour_compressor, train_colour_vae
from nlos_models.errors import CheckpointError
from nlos_models.recipe import Recipe
from nlos_models.train import OnStep

from nlos_cam.colour_data import read_colour
from nlos_cam.colour_objects import colour_images
from nlos_cam.dataset import HELD_OUT_SEED, TRAINING_SEED
from nlos_cam.errors import SceneError
from nlos_cam.objects.depth_image import object_box


def train_vae(recipe: Recipe, rig: Rig, out: Path, on_step: OnStep) -> dict[str, float]:
    """Train a colour VAE on procedural objects (SI 3), write it, return its held-out figures."""
    box = object_box(rig)
    images = colour_images(TRAINING_SEED, recipe.objects, box)
    held_out = colour_images(HELD_OUT_SEED, recipe.held_out, box)
    vae, figures = train_colour_vae(recipe, images, held_out, out, on_step)
    record = CheckpointRecord(rig_name=rig.name, rig_checksum=rig.checksum, vae_recipe=recipe, figures=figures)
    save_vae(out, vae, record)
    return figures


def train_compressor(
    recipe: Recipe, vae_folder: Path, data: Path, held_out_data: Path, out: Path, on_step: OnStep
) -> dict[str, float]:
    """Train a ResNet50 onto a colour VAE's latent (SI 4), write the pipeline, return its held-out figures.

    Raises CheckpointError for a VAE of depth, SceneError where datasets and recipe disagree.
    """
    vae, record = load_vae(vae_folder)
    if not record.colour:
        raise CheckpointError(f"{vae_folder} holds a VAE of depth images: train one by a recipe with colour = true")
    maps, rig = read_colour(data)
    held_out, other = read_colour(held_out_data)
    if len(maps.image) != recipe.objects:
        raise SceneError(
            f"{data} holds {len(maps.image)} objects, the recipe asks for {recipe.objects}: build that many"
        )
    if rig != other:
        raise SceneError(f"{data} and {held_out_data} were rendered for different rigs: build one of them again")
    pipeline, figures = train_colour_compressor(recipe, vae, maps, held_out, out, on_step)
    tied = {"rig_name": rig.name, "rig_checksum": rig.checksum}
    made_by = record.model_copy(update={**tied, "compressor_recipe": recipe, "figures": figures})
    save_pipeline(out, pipeline, made_by)
    save_vae(out, vae, made_by)
    return figures
