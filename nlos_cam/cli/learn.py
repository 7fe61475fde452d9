"""`dataset build`, `train vae|compressor`, `evaluate`: from objects to weights to figures."""

import os
from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.rig import load_rig
from nlos_models.checkpoint import CheckpointRecord, load_vae, save_pipeline, save_vae
from nlos_models.recipe import Recipe, load_recipe
from nlos_models.tasks import train_compressor, train_vae

from nlos_cam import dataset
from nlos_cam.cli.common import Json, finish, say, tracked
from nlos_cam.errors import SceneError

PAPER_RIG = "paper-rig"
RecipeFile = Annotated[Path, typer.Option("--recipe", help="A training recipe (models/recipes).", show_default=False)]
RunFolder = Annotated[Path, typer.Option("--out", help="The run's folder: log, checkpoints, weights. Resumes there.")]


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    data, train = typer.Typer(help="Training data."), typer.Typer(help="Training.")
    data.command("build")(build)
    train.command("vae")(vae)
    train.command("compressor")(compressor)
    app.add_typer(data, name="dataset")
    app.add_typer(train, name="train")


def build(
    out: Annotated[Path, typer.Option("--out", help="The dataset's folder; shards that are there are kept.")],
    count: Annotated[int, typer.Option("--count", min=1, help="Objects in all.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first object; the others follow.")] = 0,
    rig: Annotated[str, typer.Option("--rig", help="A packaged rig's name, or a rig's TOML file.")] = PAPER_RIG,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes.")] = os.cpu_count() or 1,
    json: Json = False,
) -> None:
    """Render random objects into HDF5 shards; run it again after a stop and it goes on."""
    plan = dataset.DatasetPlan(load_rig(rig), seed)
    with tracked("rendering objects") as on_progress:
        dataset.build(plan, count, out, workers=workers, on_progress=on_progress)
    finish({"objects": count, "out": str(out)}, as_json=json, text=f"{count} objects in {out}")


def vae(recipe_file: RecipeFile, out: RunFolder, json: Json = False) -> None:
    """Train a Res-VAE on procedural objects (SI 3)."""
    recipe = _recipe(recipe_file, "vae")
    rig = load_rig(PAPER_RIG)
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
    if plan.rig != other.rig:
        raise SceneError(f"{data} and {held_out_data} were rendered for different rigs: build one of them again")
    with tracked("training the compressor") as on_step:
        pipeline, figures = train_compressor(recipe, trained_vae, maps, held_out, out, on_step)
    made_by = record.model_copy(update={"compressor_recipe": recipe, "figures": figures})
    save_pipeline(out, pipeline, made_by)
    save_vae(out, trained_vae, made_by)
    finish({"out": str(out), **figures}, as_json=json, text=f"weights in {out}: {figures}")


def _recipe(path: Path, task: str) -> Recipe:
    recipe = load_recipe(path)
    if recipe.task != task:
        raise SceneError(f"{path} is a recipe for {recipe.task!r}, not {task!r}: choose another --recipe")
    return recipe
