"""`train vae|compressor|transfer|doubt`: recipes to weights."""

from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import load_encoder
from nlos_models.processes import launched
from nlos_models.recipe import SIMULATION_ONLY, Recipe
from nlos_models.run_files import digest_of

from nlos_cam.cli.common import PAPER_RIG, finish, say
from nlos_cam.cli.train_doubt import doubt
from nlos_cam.cli.train_options import Budget, HeldOut, Maps, RunOptions, refuse_ignored, with_run_options
from nlos_cam.cli.train_runs import job_of, run_compressor, run_transfer, run_vae
from nlos_cam.cli.train_start import compressor_start, transfer_start, vae_start
from nlos_cam.dataset import build
from nlos_cam.dataset.training_maps import read_maps
from nlos_cam.objects.textures import TEXTURES

Wall = Annotated[
    Path | None, typer.Option("--wall", help="The bare wall for difference maps (wall.toml); else it is rendered.")
]
Weights = Annotated[
    Path | None,
    typer.Option("--weights", help="Where a recipe that goes on from weights starts; the shipped ones unless given."),
]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    train = typer.Typer(help="Training.")
    for command in (vae, compressor, transfer, doubt):
        train.command(command.__name__)(with_run_options(command))
    app.add_typer(train, name="train")


def vae(
    run: RunOptions,
    weights: Weights = None,
    rig_name: Annotated[
        str, typer.Option("--rig", help="In whose object box objects stand: a packaged rig's name, or its TOML file.")
    ] = PAPER_RIG,
    budget: Budget = 1.0,
) -> None:
    """Train a Res-VAE on procedural objects (SI 3)."""
    recipe, rig = run.recipe("vae", budget), rig_named(rig_name)
    refuse_ignored('the recipe has start = "scratch"', {"--weights": bool(weights) and recipe.start == "scratch"})
    fabric = run.fabric(recipe)
    start, runs = vae_start(recipe, weights) if recipe.start == "weights" else (None, [])
    job = job_of(run, recipe, rig, runs, digest_of(start, rig.checksum), weights)
    box = build.DatasetPlan(rig, 0).box
    say(f"making {recipe.objects + recipe.held_out} objects")
    kinds, besides = build.Objects.without(recipe.left_out).categories, recipe.backgrounds
    textures = tuple(TEXTURES) if recipe.colour else ()
    images, held_out = (
        build.procedural_images(seed, count, box, kinds, backgrounds=besides, textures=textures)
        for seed, count in ((build.TRAINING_SEED, recipe.objects), (build.HELD_OUT_SEED, recipe.held_out))
    )
    _tell(run, recipe, launched(fabric, run_vae, job, start, images, held_out))


def compressor(
    run: RunOptions,
    data: Maps,
    held_out_data: HeldOut,
    vae_folder: Annotated[
        Path | None, typer.Option("--vae", help="A trained VAE; the shipped one unless given.")
    ] = None,
    weights: Weights = None,
    wall: Wall = None,
    stream: Annotated[
        bool, typer.Option("--stream", help="Read the maps as they are needed: for more than memory holds.")
    ] = False,
    budget: Budget = 1.0,
) -> None:
    """Train a compressor onto the latent of a trained VAE (SI 4), or as the recipe's `steps` say."""
    recipe = run.recipe("compressor", budget)
    goes_on = recipe.start == "weights" or recipe.steps == "two-then-joint"
    refuse_ignored("the recipe starts from scratch", {"--weights": bool(weights) and not goes_on})
    refuse_ignored(f"the recipe has steps = {recipe.steps!r}", {"--vae": bool(vae_folder) and recipe.steps != "two"})
    fabric = run.fabric(recipe)
    start, runs = compressor_start(recipe, vae_folder, weights)
    maps = read_maps(recipe, data, held_out_data, wall, stream=stream)
    origin = digest_of(start.vae, start.pipeline, maps.digest)
    job = job_of(run, maps.told(recipe), maps.plan.rig, runs, origin, weights, vae_folder)
    _tell(run, recipe, launched(fabric, run_compressor, job, start, maps.training, maps.held_out))


def transfer(
    run: RunOptions,
    data: Maps,
    held_out_data: HeldOut,
    weights: Weights = None,
    partial: Annotated[
        bool, typer.Option("--partial", help="Take what fits of a compressor that does not quite, and say what did.")
    ] = False,
    wall: Wall = None,
) -> None:
    """Train synthetic weights on, on a bench's recordings (SI 4): all layers, then the classifier alone."""
    recipe = run.recipe("transfer")
    fabric = run.fabric(recipe)
    pipeline, runs = transfer_start(recipe, weights, partial=partial)
    encoder = load_encoder(weights)
    maps = read_maps(recipe, data, held_out_data, wall)
    origin = digest_of(pipeline, encoder, maps.digest)
    job = job_of(run, maps.told(recipe), maps.plan.rig, runs, origin, weights)
    figures = launched(fabric, run_transfer, job, pipeline, encoder, maps.training, maps.held_out)
    told = f"weights in {run.out}: {figures['after']}, from {figures['before']}"
    finish({"out": str(run.out), **figures["after"], "before": figures["before"]}, as_json=run.json, text=told)


def _tell(run: RunOptions, recipe: Recipe, figures: dict[str, float]) -> None:
    note = SIMULATION_ONLY if recipe.colour else ""
    finish({"out": str(run.out), **figures}, as_json=run.json, text=f"weights in {run.out}: {figures}", note=note)
