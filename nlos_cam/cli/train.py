"""`train vae|compressor|transfer`: recipes to weights."""

from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import (
    CheckpointRecord,
    load_encoder,
    load_pipeline,
    load_pipeline_partly,
    load_record,
    load_vae,
    shipped_folder,
)
from nlos_models.networks import SIMULATION_ONLY, new_vae
from nlos_models.pipeline import Pipeline
from nlos_models.processes import Accelerator, launched, open_fabric
from nlos_models.recipe import Recipe
from nlos_models.res_vae import ResVae
from nlos_models.tasks import Start

from nlos_cam import dataset
from nlos_cam.cli.common import PAPER_RIG, Json, finish, say
from nlos_cam.cli.train_data import RecipeChoice, TrainingMaps, read_maps
from nlos_cam.cli.train_runs import Job, run_compressor, run_transfer, run_vae
from nlos_cam.errors import SceneError
from nlos_cam.objects.textures import TEXTURES

RecipeFile = Annotated[Path, typer.Option("--recipe", help="A training recipe (models/recipes).", show_default=False)]
RunFolder = Annotated[Path, typer.Option("--out", help="The run's folder: log, checkpoints, weights. Resumes there.")]
Maps = Annotated[Path, typer.Option("--dataset", help="Training maps, from `dataset build` or of recordings.")]
HeldOut = Annotated[Path, typer.Option("--held-out", help="Maps to judge by, of other objects.")]
Wall = Annotated[
    Path | None, typer.Option("--wall", help="The bare wall for difference maps (wall.toml); else it is rendered.")
]
Stream = Annotated[bool, typer.Option("--stream", help="Read the maps as they are needed: for more than memory holds.")]
Budget = Annotated[float, typer.Option("--budget", min=1e-4, max=1.0, help="Share of the recipe's budget.")]
Objects = Annotated[int | None, typer.Option("--objects", min=2, help="Train on so many, not on the recipe's.")]
Devices = Annotated[int, typer.Option("--devices", min=1, help="Processes: one for each GPU, or on the CPU.")]
On = Annotated[Accelerator, typer.Option("--accelerator", help="auto is a GPU if there is one.")]
Compiled = Annotated[
    bool, typer.Option("--compile", help="Networks through torch.compile: faster; needs a C++ compiler.")
]
TensorBoard = Annotated[bool, typer.Option("--tensorboard", help="Log for TensorBoard too, beside log.csv.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    train = typer.Typer(help="Training.")
    train.command("vae")(vae)
    train.command("compressor")(compressor)
    train.command("transfer")(transfer)
    app.add_typer(train, name="train")


def vae(
    recipe_file: RecipeFile,
    out: RunFolder,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights", help='Where a recipe with start = "weights" starts; the shipped weights unless given.'
        ),
    ] = None,
    budget: Budget = 1.0,
    objects: Objects = None,
    devices: Devices = 1,
    accelerator: On = "auto",
    tensorboard: TensorBoard = False,
    compiled: Compiled = False,
    json: Json = False,
) -> None:
    """Train a Res-VAE on procedural objects (SI 3)."""
    recipe = RecipeChoice(recipe_file, budget, objects).read("vae")
    rig = rig_named(PAPER_RIG)
    fabric = open_fabric(recipe, accelerator=accelerator, devices=devices)
    start = _vae(recipe, weights)[0] if recipe.start == "weights" else None
    box = dataset.DatasetPlan(rig, 0).box
    say(f"making {recipe.objects + recipe.held_out} objects")
    kinds, besides = dataset.Objects.without(recipe.left_out).categories, recipe.backgrounds
    textures = tuple(TEXTURES) if recipe.colour else ()
    images, held_out = (
        dataset.procedural_images(seed, count, box, kinds, backgrounds=besides, textures=textures)
        for seed, count in ((dataset.TRAINING_SEED, recipe.objects), (dataset.HELD_OUT_SEED, recipe.held_out))
    )
    record = CheckpointRecord(rig_name=rig.name, rig_checksum=rig.checksum, vae_recipe=recipe)
    job = Job(recipe, out, record, tensorboard, compiled)
    figures = launched(fabric, run_vae, job, start, images, held_out)
    _told(recipe, out, figures, as_json=json)


def compressor(
    recipe_file: RecipeFile,
    out: RunFolder,
    data: Maps,
    held_out_data: HeldOut,
    vae_folder: Annotated[
        Path | None, typer.Option("--vae", help="A trained VAE; the shipped one unless given.")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option("--weights", help='Two-step weights, for `two-then-joint` or start = "weights".')
    ] = None,
    wall: Wall = None,
    stream: Stream = False,
    budget: Budget = 1.0,
    objects: Objects = None,
    devices: Devices = 1,
    accelerator: On = "auto",
    tensorboard: TensorBoard = False,
    compiled: Compiled = False,
    json: Json = False,
) -> None:
    """Train a compressor onto the latent of a trained VAE (SI 4), or as the recipe's `steps` say."""
    recipe = RecipeChoice(recipe_file, budget, objects).read("compressor")
    fabric = open_fabric(recipe, accelerator=accelerator, devices=devices)
    start, record = _start(recipe, vae_folder, weights)
    maps = read_maps(recipe, data, held_out_data, wall, stream=stream)
    record = _tied(record, maps, recipe).model_copy(update={"compressor_recipe": recipe})
    job = Job(recipe, out, record, tensorboard, compiled)
    figures = launched(fabric, run_compressor, job, start, maps.training, maps.held_out)
    _told(recipe, out, figures, as_json=json)


def _told(recipe: Recipe, out: Path, figures: dict[str, float], *, as_json: bool) -> None:
    note = SIMULATION_ONLY if recipe.colour else ""
    finish({"out": str(out), **figures}, as_json=as_json, text=f"weights in {out}: {figures}", note=note)


def transfer(
    recipe_file: RecipeFile,
    out: RunFolder,
    data: Maps,
    held_out_data: HeldOut,
    weights: Annotated[
        Path | None, typer.Option("--weights", help="Where to start; the shipped weights unless given.")
    ] = None,
    partial: Annotated[
        bool, typer.Option("--partial", help="Take what fits of a compressor that does not quite, and say what did.")
    ] = False,
    wall: Wall = None,
    objects: Objects = None,
    devices: Devices = 1,
    accelerator: On = "auto",
    tensorboard: TensorBoard = False,
    compiled: Compiled = False,
    json: Json = False,
) -> None:
    """Train synthetic weights on, on a bench's recordings (SI 4): all layers, then the classifier alone."""
    recipe = RecipeChoice(recipe_file, objects=objects).read("transfer")
    fabric = open_fabric(recipe, accelerator=accelerator, devices=devices)
    pipeline, record = _synthetic(weights, partial=partial)
    _same_kind(recipe, record, weights)
    maps = read_maps(recipe, data, held_out_data, wall)
    record = _tied(record, maps, recipe).model_copy(update={"transfer_recipe": recipe})
    job, encoder = Job(recipe, out, record, tensorboard, compiled), load_encoder(weights)
    figures = launched(fabric, run_transfer, job, pipeline, encoder, maps.training, maps.held_out)
    told = f"weights in {out}: {figures['after']}, from {figures['before']}"
    finish({"out": str(out), **figures["after"], "before": figures["before"]}, as_json=json, text=told)


def _start(recipe: Recipe, vae_folder: Path | None, weights: Path | None) -> tuple[Start, CheckpointRecord | None]:
    """What the recipe's steps set out from, and its record; none where they set out from nothing."""
    if recipe.steps == "one":
        return Start(), None
    if recipe.steps == "two":
        trained, record = _vae(recipe, vae_folder)
        return Start(trained, _weights(recipe, weights)[0] if recipe.start == "weights" else None), record
    pipeline, record = _weights(recipe, weights)
    trained = new_vae(colour=recipe.colour)
    if encoder := load_encoder(weights):
        trained.encoder = encoder
    elif recipe.latent_weight:
        raise SceneError(f"{weights} has no encoder to aim at: set latent_weight = 0 in the recipe")
    trained.decoder = pipeline.decoder
    return Start(trained, pipeline), record


def _synthetic(weights: Path | None, *, partial: bool) -> tuple[Pipeline, CheckpointRecord]:
    if not partial:
        return load_pipeline(weights)
    pipeline, record, report = load_pipeline_partly(weights or shipped_folder())
    say(f"compressor: {report}")
    return pipeline, record


def _vae(recipe: Recipe, folder: Path | None) -> tuple[ResVae, CheckpointRecord]:
    _same_colour(recipe, load_record(folder or shipped_folder()), folder)
    return load_vae(folder or shipped_folder())


def _weights(recipe: Recipe, folder: Path | None) -> tuple[Pipeline, CheckpointRecord]:
    _same_kind(recipe, load_record(folder or shipped_folder()), folder)
    return load_pipeline(folder)


def _same_colour(recipe: Recipe, record: CheckpointRecord, folder: Path | None) -> None:
    if record.colour != recipe.colour:
        holds, wants = (f"in colour ({SIMULATION_ONLY})" if one.colour else "of depth" for one in (record, recipe))
        raise SceneError(
            f"{folder or 'what is shipped'} holds weights {holds}, the recipe is {wants}: name others with --vae or "
            "--weights"
        )


def _same_kind(recipe: Recipe, record: CheckpointRecord, folder: Path | None) -> None:
    _same_colour(recipe, record, folder)
    if record.input != recipe.maps:
        raise SceneError(f"these weights eat {record.input}, the recipe says {recipe.maps}: change one of them")


def _tied(record: CheckpointRecord | None, maps: TrainingMaps, recipe: Recipe) -> CheckpointRecord:
    """The record of weights for the rig and the kind of these maps."""
    rig = maps.plan.rig
    tied = CheckpointRecord(rig_name=rig.name, rig_checksum=rig.checksum, input=recipe.maps)
    recipes = ("vae_recipe", "compressor_recipe", "transfer_recipe")
    return tied.model_copy(update={name: getattr(record, name) for name in recipes}) if record else tied
