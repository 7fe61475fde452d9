"""`train vae|compressor|transfer|doubt`: recipes to weights.

The options that the three `train` commands share, each written once.

`train doubt`: what a pipeline makes of ordinary objects, empty benches and outliers, to a network that doubts it.
"""

import inspect
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from lightning_fabric import Fabric
from nlos_calibration import Rig, rig_named
from nlos_models import (
    DOUBT_RECORD,
    SIMULATION_ONLY,
    Accelerator,
    DoubtRecord,
    Figures,
    OnStep,
    Recipe,
    Running,
    TrainingRun,
    check_run_folder,
    checksum_of_watched,
    compressor_start,
    digest_of,
    launched,
    load_encoder,
    load_recipe,
    load_reconstructor,
    new_record,
    open_fabric,
    run_compressor,
    run_doubt,
    run_transfer,
    run_vae,
    shipped_folder,
    transfer_start,
    vae_start,
)

from nlos_cam.cli.common import PAPER_RIG, Json, finish, progress, say, stop_on_signals, tracked
from nlos_cam.dataset import (
    HELD_OUT_SEED,
    TO_LEARN,
    TRAINING_SEED,
    DatasetPlan,
    Objects,
    check_doubt_data,
    doubt_sets,
    open_dataset,
    procedural_images,
    read_maps,
)
from nlos_cam.errors import OutputExistsError, SceneError
from nlos_cam.files import cache_folder
from nlos_cam.objects import TEXTURES

Budget = Annotated[float, typer.Option("--budget", min=1e-4, max=1.0, help="Share of the recipe's budget.")]


@dataclass(frozen=True)
class RunOptions:
    """What is run, where to, and how; each field is an option of every command."""

    recipe_file: Annotated[
        Path, typer.Option("--recipe", help="A training recipe (models/recipes).", show_default=False)
    ]
    out: Annotated[Path, typer.Option("--out", help="The run's folder: log, checkpoints, weights. Resumes there.")]
    objects: Annotated[int | None, typer.Option("--objects", min=2, help="Train on so many, not on the recipe's.")] = (
        None
    )
    devices: Annotated[int, typer.Option("--devices", min=1, help="Processes: one for each GPU, or on the CPU.")] = 1
    accelerator: Annotated[Accelerator, typer.Option("--accelerator", help="auto is a GPU if there is one.")] = "auto"
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Log for TensorBoard too, beside log.csv.")] = False
    compiled: Annotated[
        bool, typer.Option("--compile", help="Networks through torch.compile: faster; needs a C++ compiler.")
    ] = False
    json: Json = False

    def recipe(self, task: str, budget: float = 1.0) -> Recipe:
        """The recipe, at a share of its budget. Raises SceneError where it is another task's."""
        recipe = load_recipe(self.recipe_file)
        if recipe.task != task:
            told = f"{self.recipe_file} is a recipe for {recipe.task!r}, not {task!r}"
            raise SceneError(f"{told}: choose another --recipe")
        if self.objects is not None:
            recipe = recipe.of_objects(self.objects)
        return recipe.scaled(budget)

    def fabric(self, recipe: Recipe) -> Fabric:
        """What the recipe is run on."""
        return open_fabric(recipe, accelerator=self.accelerator, devices=self.devices)

    def training(
        self, recipe: Recipe, rig: Rig, before: list[Recipe], origin: str, *starts: Path | None
    ) -> TrainingRun:
        """Return the run of a recipe after earlier runs. Raises OutputExistsError where it would overwrite weights."""
        record = new_record(recipe, (rig.name, rig.checksum), before)
        check_run_folder(self.out, record, *starts)
        return TrainingRun(recipe, self.out, record, self.tensorboard, self.compiled, origin, watched_run)


@contextmanager
def watched_run(fabric: Fabric, training: TrainingRun, name: str) -> Generator[tuple[OnStep, Running]]:
    """Show a run's progress, in the leading process; Ctrl-C or SIGTERM ends it after the current step, saved."""
    with progress() as bar, stop_on_signals() as stop:
        title = f"training the {name}" + (f" in colour ({SIMULATION_ONLY})" if training.recipe.colour else "")
        task = bar.add_task(title, total=None, visible=fabric.is_global_zero)

        def on_step(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        def on_epoch(row: Figures) -> None:
            text = f"epoch {row['epoch'] + 1:.0f} done, loss {row['loss']:.4g}, held out {row['held_out_loss']:.4g}"
            bar.update(task, description=f"{title}: {text}")

        yield on_step, replace(training.running(fabric), stop=stop.is_set, tell=say, on_epoch=on_epoch)


def refuse_ignored(why: str, given: dict[str, bool]) -> None:
    """Raise SceneError for the first option that is given and would be ignored."""
    for option in (option for option, is_given in given.items() if is_given):
        raise SceneError(f"{why}, so that {option} would do nothing: leave it out, or change the recipe")


def with_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command as typer wants it: the fields of RunOptions, spelt out, in the place of its parameter `run`."""
    shared = inspect.signature(RunOptions).parameters
    own = [each for name, each in inspect.signature(command).parameters.items() if name != "run"]

    @wraps(command)
    def spelt_out(**given: Any) -> None:
        command(run=RunOptions(**{name: given.pop(name) for name in shared}), **given)

    every = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*shared.values(), *own)]
    spelt_out.__annotations__ = {each.name: each.annotation for each in every}
    spelt_out.__dict__["__signature__"] = inspect.Signature(every)
    return spelt_out


Maps = Annotated[Path, typer.Option("--dataset", help="Training maps, from `dataset build` or of recordings.")]


HeldOut = Annotated[Path, typer.Option("--held-out", help="Maps to judge by, of other objects.")]


SAMPLES = "samples"


def doubt(
    run: RunOptions,
    data: Maps,
    held_out_data: HeldOut,
    weights: Annotated[
        Path | None, typer.Option("--weights", help="Whose images are doubted; the shipped ones unless given.")
    ] = None,
) -> None:
    """Train a doubt network on what trained weights make of maps; the run's folder is then a folder of weights."""
    recipe, watched = run.recipe("doubt"), weights or shipped_folder()
    fabric = run.fabric(recipe)
    pipeline = load_reconstructor(weights, cache_folder() / "onnx")
    training, judging = (open_dataset(folder) for folder in (data, held_out_data))
    check_doubt_data(recipe, pipeline, training, judging)
    about = DoubtRecord(watches=checksum_of_watched(watched), recipe=recipe, learnt=list(TO_LEARN))
    if run.out.resolve() == watched.resolve() or (run.out / DOUBT_RECORD).exists():
        raise OutputExistsError(f"{run.out} holds weights already: choose another --out")
    with tracked("rendering empty benches and outliers") as on_progress:
        sets = doubt_sets(recipe, pipeline, (training, judging), run.out / SAMPLES, on_progress)
    job = TrainingRun(recipe, run.out, pipeline.record, run.tensorboard, run.compiled, about.watches, watched_run)
    figures = launched(fabric, run_doubt, job, about, watched, *sets)
    finish({"out": str(run.out), **figures}, as_json=run.json, text=f"weights with their doubt in {run.out}: {figures}")


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
    job = run.training(recipe, rig, runs, digest_of(start, rig.checksum), weights)
    box = DatasetPlan(rig, 0).box
    say(f"making {recipe.objects + recipe.held_out} objects")
    kinds, besides = Objects.without(recipe.left_out).categories, recipe.backgrounds
    textures = tuple(TEXTURES) if recipe.colour else ()
    images, held_out = (
        procedural_images(seed, count, box, kinds, backgrounds=besides, textures=textures)
        for seed, count in ((TRAINING_SEED, recipe.objects), (HELD_OUT_SEED, recipe.held_out))
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
    job = run.training(maps.told(recipe), maps.plan.rig, runs, origin, weights, vae_folder)
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
    pipeline, runs = transfer_start(recipe, weights, partial=partial, on_report=say)
    encoder = load_encoder(weights)
    maps = read_maps(recipe, data, held_out_data, wall)
    origin = digest_of(pipeline, encoder, maps.digest)
    job = run.training(maps.told(recipe), maps.plan.rig, runs, origin, weights)
    figures = launched(fabric, run_transfer, job, pipeline, encoder, maps.training, maps.held_out)
    told = f"weights in {run.out}: {figures['after']}, from {figures['before']}"
    finish({"out": str(run.out), **figures["after"], "before": figures["before"]}, as_json=run.json, text=told)


def _tell(run: RunOptions, recipe: Recipe, figures: dict[str, float]) -> None:
    note = SIMULATION_ONLY if recipe.colour else ""
    finish({"out": str(run.out), **figures}, as_json=run.json, text=f"weights in {run.out}: {figures}", note=note)
