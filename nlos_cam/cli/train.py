"""`train vae|compressor`: recipes to weights."""

from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import CheckpointRecord, load_vae, save_pipeline, save_vae
from nlos_models.recipe import Recipe, load_recipe
from nlos_models.tasks import train_compressor, train_vae

from nlos_cam import dataset
from nlos_cam.cli.common import PAPER_RIG, Json, finish, say, tracked
from nlos_cam.errors import SceneError

RecipeFile = Annotated[Path, typer.Option("--recipe", help="A training recipe (models/recipes).", show_default=False)]
RunFolder = Annotated[Path, typer.Option("--out", help="The run's folder: log, checkpoints, weights. Resumes there.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    train = typer.Typer(help="Training.")
    train.command("vae")(vae)
    train.command("compressor")(compressor)
    app.add_typer(train, name="train")


def vae(recipe_file: RecipeFile, out: RunFolder, json: Json = False) -> None:
    """Train a Res-VAE on procedural objects (SI 3)."""
    recipe = _recipe(recipe_file, "vae")
    rig = rig_named(PAPER_RIG)
    box = dataset.DatasetPlan(rig, 0).box
    say(f"making {recipe.objects + recipe.held_out} objects")
    images = dataset.procedural_images(dataset.TRAINING_SEED, recipe.objects, box)
    held_out = dataset.procedural_images(dataset.HELD_OUT_SEED, recipe.held_out, box)
    with tracked("training the VAE") as on_step:
        trained, figures = train_vae(recipe, images, held_out, out, on_step)
    save_vae(
        out, trained, CheckpointRecord(rig_name=rig.name, rig_checksum=rig.checksum, vae_recipe=recipe, figures=figures)
    )
    finish({"out": str(out), **figures}, as_json=json, text=f"weights in {out}: {figures}")


def compressor(
    recipe_file: RecipeFile,
    out: RunFolder,
    vae_folder: Annotated[Path, typer.Option("--vae", help="The folder of a trained VAE.")],
    data: Annotated[Path, typer.Option("--dataset", help="Training maps, from `dataset build`.")],
    held_out_data: Annotated[Path, typer.Option("--held-out", help="Maps to judge by, of other seeds.")],
    json: Json = False,
) -> None:
    """Train a compressor onto the latent of a trained VAE (SI 4)."""
    recipe = _recipe(recipe_file, "compressor")
    trained_vae, record = load_vae(vae_folder)
    maps, plan = dataset.read(data)
    held_out, other = dataset.read(held_out_data)
    if len(maps.image) != recipe.objects:
        raise SceneError(
            f"{data} holds {len(maps.image)} objects, the recipe asks for {recipe.objects}: build that many"
        )
    if plan.rig != other.rig:
        raise SceneError(f"{data} and {held_out_data} were rendered for different rigs: build one of them again")
    with tracked("training the compressor") as on_step:
        pipeline, figures = train_compressor(recipe, trained_vae, maps, held_out, out, on_step)
    tied = {"rig_name": plan.rig.name, "rig_checksum": plan.rig.checksum}
    made_by = record.model_copy(update={**tied, "compressor_recipe": recipe, "figures": figures})
    save_pipeline(out, pipeline, made_by)
    save_vae(out, trained_vae, made_by)
    finish({"out": str(out), **figures}, as_json=json, text=f"weights in {out}: {figures}")


def _recipe(path: Path, task: str) -> Recipe:
    recipe = load_recipe(path)
    if recipe.task != task:
        raise SceneError(f"{path} is a recipe for {recipe.task!r}, not {task!r}: choose another --recipe")
    return recipe
