"""`dataset build`, `train vae|compressor`, `evaluate`: from objects to weights to figures."""

import os
import time
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import CheckpointRecord, load_vae, save_pipeline, save_vae
from nlos_models.inference import load_reconstructor
from nlos_models.recipe import Recipe, load_recipe
from nlos_models.tasks import train_compressor, train_vae

from nlos_cam import dataset
from nlos_cam import evaluate as judging
from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, say, tracked
from nlos_cam.errors import SceneError
from nlos_cam.objects.depth_image import FARTHEST_V

PAPER_RIG = "paper-rig"
RecipeFile = Annotated[Path, typer.Option("--recipe", help="A training recipe (models/recipes).", show_default=False)]
RunFolder = Annotated[Path, typer.Option("--out", help="The run's folder: log, checkpoints, weights. Resumes there.")]


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    data, train = typer.Typer(help="Training data."), typer.Typer(help="Training.")
    data.command("build")(build)
    train.command("vae")(vae)
    train.command("compressor")(compressor)
    app.command("evaluate")(evaluate)
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
    plan = dataset.DatasetPlan(rig_named(rig), seed)
    with tracked("rendering objects") as on_progress:
        dataset.build(plan, count, out, workers=workers, on_progress=on_progress)
    finish({"objects": count, "out": str(out)}, as_json=json, text=f"{count} objects in {out}")


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


def evaluate(
    out: Annotated[Path, typer.Option("--out", help="A folder for figures and the contact sheet.")],
    data: Annotated[
        Path | None, typer.Option("--dataset", help="Judge on these maps, not on the test objects.")
    ] = None,
    training: Annotated[
        Path | None, typer.Option("--training", help="Training maps, for the nearest neighbour.")
    ] = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Other weights than the shipped ones.")] = None,
    count: Annotated[int, typer.Option("--count", min=1, help="Test objects to render.")] = 240,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Judge the reconstruction on objects never trained on, beside the trivial baselines."""
    folder, started = output_path(out, "evaluation", "", overwrite=overwrite), time.perf_counter()
    reconstructor = load_reconstructor(weights, cache_folder() / "onnx")
    if reconstructor.record.input != "raw maps":
        raise SceneError(
            f"these weights eat {reconstructor.record.input}, and datasets hold raw maps: use other weights"
        )
    plan = dataset.DatasetPlan(rig_named(reconstructor.record.rig_name), dataset.TEST_SEED)
    if data:
        maps, plan = dataset.read(data)
    else:
        with tracked("rendering test objects") as on_progress:
            maps = judging.sense_test_objects(plan.rig, plan.box, plan.first_seed, count, on_progress)
    trained_on = dataset.procedural_images(dataset.TRAINING_SEED, 2000, plan.box)
    guesses = judging.baselines(maps, trained_on, dataset.read(training)[0] if training else None)
    mm_per_v = 1000 * (plan.box.z_far_m - plan.box.z_near_m) / (1 - FARTHEST_V)
    truth, image = maps.image.astype(np.float32), judging.reconstruct_all(reconstructor, maps)
    figures = {name: asdict(value) for name, value in judging.judge(image, truth, mm_per_v).items()}
    trivial = {
        name: {metric: asdict(value) for metric, value in judging.judge(guess, truth, mm_per_v).items()}
        for name, guess in guesses.items()
    }
    result = {**figures, "baselines": trivial, "objects": len(truth), "seconds": time.perf_counter() - started}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "figures.json").write_text(dumps(result, indent=2) + "\n", encoding="utf-8")
    judging.draw_sheet(folder / "sheet.png", image, truth)
    iou = figures["silhouette_iou"]
    text = (
        f"silhouette IoU {iou['value']:.3f} ({iou['low']:.3f} to {iou['high']:.3f}) on {len(truth)} objects: {folder}"
    )
    finish({**result, "out": str(folder)}, as_json=json, text=text)


def _recipe(path: Path, task: str) -> Recipe:
    recipe = load_recipe(path)
    if recipe.task != task:
        raise SceneError(f"{path} is a recipe for {recipe.task!r}, not {task!r}: choose another --recipe")
    return recipe
