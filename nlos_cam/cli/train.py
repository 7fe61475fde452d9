"""`train vae|compressor|direct|transfer|doubt`: recipes to weights, with the options that these
commands share.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

import nlos_calibration as walls
import nlos_models as models
import typer
from nlos_models import training

from nlos_cam import bench as benches
from nlos_cam import dataset as data_sets
from nlos_cam import objects as shapes
from nlos_cam import reconstruct
from nlos_cam.cli.common import (
    PAPER_RIG,
    Json,
    finish,
    interrupted_by_signals,
    progress,
    refuse_ignored,
    say,
    stop_on_signals,
    tracked,
)
from nlos_cam.errors import SceneError
from nlos_cam.files import cache_folder

if TYPE_CHECKING:
    from lightning_fabric import Fabric

R = TypeVar("R", bound=training.Recipe)
SAMPLES = "samples"
"""Folder of rendered samples in the output folder of `train doubt`."""

Budget = Annotated[
    float, typer.Option("--budget", min=1e-4, max=1.0, help="Share of the recipe's budget.")
]
Maps = Annotated[
    Path, typer.Option("--dataset", help="Training maps, from `dataset build` or `dataset label`.")
]
HeldOut = Annotated[Path, typer.Option("--held-out", help="Held-out maps, of other objects.")]
Wall = Annotated[
    Path | None,
    typer.Option("--wall", help="Bare wall for difference maps (wall.toml; default: rendered)."),
]
Weights = Annotated[
    Path | None,
    typer.Option("--weights", help="Weights that the run starts from (default: the paper's)."),
]


@dataclass(frozen=True)
class RunOptions:
    """Options that every `train` command has."""

    recipe_file: Annotated[
        Path, typer.Option("--recipe", help="Training recipe (models/recipes).", show_default=False)
    ]
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Output folder: log, checkpoints, weights. An interrupted run resumes there.",
        ),
    ]
    objects: Annotated[
        int | None,
        typer.Option(
            "--objects", min=2, help="Number of training objects (default: the recipe's)."
        ),
    ] = None
    devices: Annotated[
        int,
        typer.Option("--devices", min=1, help="Number of processes, one per GPU or on the CPU."),
    ] = 1
    accelerator: Annotated[
        Literal["auto", "cpu", "cuda"],
        typer.Option("--accelerator", help="Device; auto: a GPU if there is one, else the CPU."),
    ] = "auto"
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Also log for TensorBoard.")
    ] = False
    compiled: Annotated[
        bool,
        typer.Option(
            "--compile",
            help="Run the networks through torch.compile; needs a C++ compiler, and is faster but for"
            " the compressor on a CPU.",
        ),
    ] = False
    json: Json = False

    def recipe(self, kind: type[R], budget: float = 1.0) -> R:
        """Return the recipe at a share of its budget. Raises SceneError where it is for another
        task.
        """
        recipe = training.load_recipe(self.recipe_file)
        if not isinstance(recipe, kind):
            (task,) = get_args(kind.model_fields["task"].annotation)
            raise SceneError(
                f"{self.recipe_file} is a recipe for {recipe.task!r}, not {task!r}: choose another"
                " --recipe"
            )
        if self.objects is not None:
            recipe = recipe.of_objects(self.objects)
        return recipe.scaled(budget)

    def fabric(self, recipe: training.Recipe) -> Fabric:
        """Open the devices that the recipe is run on."""
        return training.open_fabric(recipe, accelerator=self.accelerator, devices=self.devices)

    def training(
        self, recipe: R, record: models.CheckpointRecord, origin: str
    ) -> training.TrainingRun[R]:
        """Return a run with progress and interruption; `record` is that of its weights, `origin` a
        `digest_of`.
        """
        return training.TrainingRun(
            recipe, self.out, record, origin, self.tensorboard, self.compiled, watched_run
        )

    def finish(self, recipe: training.Recipe, figures: training.Scores) -> None:
        """End a command with the figures of its weights."""
        finish(
            {"out": str(self.out), **figures},
            as_json=self.json,
            text=f"weights in {self.out}: {_values(figures)}",
            note=models.SIMULATION_ONLY if recipe.colour else "",
        )

    def finish_transfer(
        self, before: training.Scores, after: training.Scores, *, can_keep: bool
    ) -> None:
        """End a transfer with the figures of the weights before and after, and say which of both
        are in `out`.
        """
        better = training.is_better(after, before) or not can_keep
        fitted = self.out if better else self.out / training.FITTED
        compared = f"{_values(after)}; before: {_values(before)}"
        text = (
            f"weights in {self.out}: {compared}"
            if better
            else f"The fitted weights are not better: {compared}\n"
            f"{self.out} holds the earlier weights, {fitted} the fitted ones"
        )
        kept = "fitted" if better else "earlier"
        result = {"out": str(self.out), **after, "before": before, "kept": kept}
        finish({**result, "fitted": str(fitted)}, as_json=self.json, text=text)


@contextmanager
def watched_run(
    running: training.Running, recipe: training.Recipe, name: str
) -> Generator[training.Running]:
    """Show a run's progress, in the leading process; Ctrl-C or SIGTERM ends it after the current
    step, saved.
    """
    with progress() as bar, stop_on_signals("interrupting: saving after this step") as stop:
        title = f"training the {name}" + (
            f" in color ({models.SIMULATION_ONLY})" if recipe.colour else ""
        )
        task = bar.add_task(
            title, total=None, visible=running.fabric is None or running.fabric.is_global_zero
        )

        def on_step(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        def on_epoch(row: training.Scores) -> None:
            text = (
                f"epoch {row['epoch'] + 1:.0f} done, loss {row['loss']:.4g}, held out"
                f" {row['held_out_loss']:.4g}"
            )
            bar.update(task, description=f"{title}: {text}")

        yield replace(running, stop=stop.is_set, on_message=say, on_step=on_step, on_epoch=on_epoch)


def with_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace a command's parameter `run` by the fields of RunOptions, so that typer sees each as
    an option.
    """
    shared = inspect.signature(RunOptions, eval_str=True).parameters
    own = [
        each
        for name, each in inspect.signature(command, eval_str=True).parameters.items()
        if name != "run"
    ]

    @wraps(command)
    def expanded(**values: Any) -> None:
        run = RunOptions(**{name: values.pop(name) for name in shared})
        try:
            command(run=run, **values)
        except KeyboardInterrupt as interruption:
            raise KeyboardInterrupt(
                f"once training has begun, the same command resumes in {run.out}"
            ) from interruption

    every = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*shared.values(), *own)]
    expanded.__annotations__ = {each.name: each.annotation for each in every}
    expanded.__dict__["__signature__"] = inspect.Signature(every)
    return expanded


def register(app: typer.Typer) -> None:
    """Add the commands."""
    train = typer.Typer(help="Training.")
    for command in (vae, compressor, direct, transfer, doubt):
        train.command(command.__name__)(with_run_options(command))
    train.command("quality")(quality)
    app.add_typer(train, name="train")


def vae(
    run: RunOptions,
    weights: Weights = None,
    rig_name: Annotated[
        str,
        typer.Option(
            "--rig",
            help="Rig whose object box the objects stand in: a packaged rig, or a TOML file.",
        ),
    ] = PAPER_RIG,
    budget: Budget = 1.0,
) -> None:
    """Train a Res-VAE on procedural objects (SI 3)."""
    recipe = run.recipe(training.VaeRecipe, budget)
    rig = walls.rig_named(rig_name)
    refuse_ignored(
        'the recipe has start = "scratch"',
        {"--weights": bool(weights) and recipe.start == "scratch"},
    )
    fabric = run.fabric(recipe)
    start, runs = training.vae_start(recipe, weights) if recipe.start != "scratch" else (None, [])
    name = rig.name, rig.checksum
    fields = reconstruct.rig_fields(rig)
    record = training.record_run(recipe, run.out, name, runs, weights, bench=fields)
    job = run.training(recipe, record, training.digest_of(start, rig.checksum))
    say(f"generating {recipe.objects + recipe.held_out} objects")
    box = data_sets.DatasetPlan(rig, 0).box
    kinds = data_sets.Objects.without(recipe.left_out).categories
    textures = tuple(shapes.TEXTURES) if recipe.colour else ()
    images, held_out = (
        data_sets.procedural_images(
            seed, count, box, kinds, backgrounds=recipe.backgrounds, textures=textures
        )
        for seed, count in (
            (data_sets.TRAINING_SEED, recipe.objects),
            (data_sets.HELD_OUT_SEED, recipe.held_out),
        )
    )
    run.finish(recipe, training.launch(fabric, training.run_vae, job, start, images, held_out))


def compressor(
    run: RunOptions,
    data: Maps,
    held_out_data: HeldOut,
    vae_folder: Annotated[
        Path | None, typer.Option("--vae", help="Trained VAE (default: the paper's).")
    ] = None,
    weights: Weights = None,
    wall: Wall = None,
    stream: Annotated[
        bool,
        typer.Option(
            "--stream", help="Read maps from disk as needed, for datasets larger than memory."
        ),
    ] = False,
    budget: Budget = 1.0,
) -> None:
    """Train a compressor onto the latent of a trained VAE (SI 4), or as the recipe's `steps`
    say.
    """
    recipe = run.recipe(training.CompressorRecipe, budget)
    scratch = recipe.start != "weights" and recipe.steps != "two-then-joint"
    refuse_ignored("the recipe starts from scratch", {"--weights": bool(weights) and scratch})
    refuse_ignored(
        f"the recipe has steps = {recipe.steps!r}",
        {"--vae": bool(vae_folder) and recipe.steps != "two"},
    )
    fabric = run.fabric(recipe)
    start, runs = training.compressor_start(recipe, vae_folder, weights)
    maps = data_sets.read_maps(recipe, data, held_out_data, wall, stream=stream)
    recipe = maps.limit_recipe(recipe)
    record = maps.record_run(recipe, run.out, runs, weights, vae_folder)
    job = run.training(recipe, record, training.digest_of(start.vae, start.pipeline, maps.digest))
    run.finish(
        recipe,
        training.launch(fabric, training.run_compressor, job, start, maps.training, maps.held_out),
    )


def direct(
    run: RunOptions,
    data: Annotated[
        list[Path],
        typer.Option(
            "--dataset", help="Training maps; may be repeated. New shards are used as they appear."
        ),
    ],
    held_out_data: HeldOut,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights", help='Direct weights that a recipe with start = "weights" goes on from.'
        ),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(
            "--store", help="Folder of the packed maps, kept for other runs (default: in --out)."
        ),
    ] = None,
    pack_workers: Annotated[
        int,
        typer.Option(
            "--pack-workers",
            min=1,
            help="Processes that pack new shards: more than one where a GPU would wait for them.",
        ),
    ] = 1,
) -> None:
    """Train a direct network: maps to images by two heads, without a latent; the project's own."""
    recipe = run.recipe(training.DirectRecipe)
    refuse_ignored(
        "the recipe starts from scratch", {"--weights": bool(weights) and recipe.start == "scratch"}
    )
    if run.devices > 1:
        raise SceneError(
            f"a direct network trains in one process, got --devices {run.devices}: drop it"
        )
    fabric = run.fabric(recipe)
    start, runs = training.direct_start(recipe, weights)
    with ExitStack() as held:
        with tracked("packing maps") as on_progress:
            trained = models.load_record(models.weights_folder(weights)) if start else None
            options = data_sets.StoreOptions(
                normal=start.normal if start else None,
                trained=trained,
                color=recipe.colour,
                maps_rig=reconstruct.grid_of(trained) if trained else None,
                run=f"{run.out.resolve()} ",
                held_out=held_out_data,
                pack_now=False,
            )
            folder = store or run.out / "packed"
            packed = data_sets.open_packed_maps(data, folder, options, processes=pack_workers)
            source = held.enter_context(packed)
            held_out = source.held_out(held_out_data, recipe.held_out)
            recipe = recipe.model_copy(update={"held_out": len(held_out.image)})
            # before the packing, which can take many minutes: it refuses the folder of another run
            record = source.record_run(recipe, run.out, runs, weights)
            source.refresh(on_progress)
        if not training.has_state(run.out):
            source.forget_run()
        # The best epoch is that of these held-out maps: a run cannot go on with others.
        judged = data_sets.data_key(data_sets.open_dataset(held_out_data, color=recipe.colour))
        job = run.training(recipe, record, training.digest_of(start, source.digest, judged))
        earlier = training.digest_of(start, source.digest) if start else source.digest
        job = replace(job, earlier_origin=earlier)
        run.finish(recipe, training.run_direct(fabric, job, start, source, held_out))


def transfer(
    run: RunOptions,
    data: Maps,
    held_out_data: HeldOut,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights",
            help="Weights to fit (default: paper for a recipe with a latent, else direct).",
        ),
    ] = None,
    vae_folder: Annotated[
        Path | None,
        typer.Option(
            "--vae", help="VAE whose encoder gives the target latents (default: the weights')."
        ),
    ] = None,
    partial: Annotated[
        bool,
        typer.Option(
            "--partial", help="Load matching layers only, and report which ones were loaded."
        ),
    ] = False,
    wall: Wall = None,
) -> None:
    """Fine-tune synthetic weights on a bench's recordings (SI 4): all layers first, then the
    classifier alone.

    If the held-out loss has not fallen, --out gets a copy of the earlier weights, and the fitted
    ones lie in its folder `fitted`.
    """
    recipe = run.recipe(training.TransferRecipe)
    fabric = run.fabric(recipe)
    pipeline, start = training.transfer_start(recipe, weights, partial=partial, on_report=say)
    refuse_ignored(
        "the weights are a direct network",
        {
            "--vae": bool(vae_folder and start.direct_recipe),
            "--compile": bool(run.compiled and start.direct_recipe),
        },
        instead="choose weights with a latent",
    )
    # Half of loaded weights are nothing to go back to.
    earlier = None if partial else training.transfer_weights(recipe, weights)
    encoder = training.load_encoder(vae_folder or weights)
    if vae_folder and encoder is None:
        raise SceneError(f"--vae {vae_folder} has no encoder: give a folder from `train vae`")
    maps = data_sets.read_maps(recipe, data, held_out_data, wall, start=start)
    recipe = maps.limit_recipe(recipe)
    record = maps.record_run(recipe, run.out, start.runs, weights, trained=start)
    job = run.training(recipe, record, training.digest_of(pipeline, encoder, maps.digest))
    figures = training.launch(
        fabric,
        training.run_transfer,
        job,
        pipeline,
        encoder,
        maps.training,
        maps.held_out,
        earlier,
    )
    run.finish_transfer(**figures, can_keep=not partial)


def doubt(
    run: RunOptions,
    data: Maps,
    held_out_data: HeldOut,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", help="Weights whose images are judged (default: direct)."),
    ] = None,
) -> None:
    """Train the uncertainty ("doubt") network of trained weights; --out then holds a copy of these
    weights too.
    """
    recipe = run.recipe(training.UncertaintyRecipe)
    watched = models.weights_folder(weights)
    fabric = run.fabric(recipe)
    pipeline = models.load_reconstructor(weights, cache_folder() / "onnx")
    datasets = data_sets.open_dataset(data), data_sets.open_dataset(held_out_data)
    data_sets.check_uncertainty_data(recipe, pipeline, *datasets)
    available = min(recipe.held_out, len(datasets[1]))
    recipe = recipe.model_copy(update={"held_out": available})
    kinds = list(data_sets.outliers_beside(datasets[0].plan.objects.share_generic))
    about = training.record_uncertainty_run(recipe, run.out, watched, kinds)
    with tracked("rendering empty benches and outliers") as on_progress:
        sets = data_sets.uncertainty_sets(
            recipe, pipeline, datasets, run.out / SAMPLES, on_progress
        )
    keys = map(data_sets.data_key, datasets)
    job = run.training(recipe, pipeline.record, training.digest_of(about.watches, *keys))
    run.finish(
        recipe, training.launch(fabric, training.run_uncertainty, job, about, watched, *sets)
    )


def quality(
    weights: Annotated[
        Path,
        typer.Option("--weights", help="Weights with an uncertainty network; gets quality.json."),
    ],
    data: Annotated[
        Path,
        typer.Option(
            "--dataset", help="Maps that the weights were not trained on, with generic shapes."
        ),
    ],
    objects: Annotated[int, typer.Option("--objects", min=100, help="Number of objects.")] = 6000,
    json: Json = False,
) -> None:
    """Fit the model that predicts the outline's overlap and the depth error; judged on kinds left
    out of the fit.
    """
    weights = models.weights_folder(weights)
    graphs = cache_folder() / "onnx"
    if weights.resolve().parent == models.shipped_folder().resolve().parent:
        raise SceneError(
            f"{weights} came with the program, and is not changed: give a copy of the folder"
        )
    if benches.is_bench(weights.resolve().parent):
        raise SceneError(
            f"{weights} belongs to a bench, whose record has its checksum: give a copy of the folder"
        )
    pipeline = models.load_reconstructor(weights, graphs)
    # An old or damaged quality model is replaced, so that it is not read.
    uncertainty_model = models.load_uncertainty_model(weights, graphs, quality=False)
    if uncertainty_model is None:
        raise SceneError(f"{weights} has no uncertainty network: train one with `train doubt`")
    with interrupted_by_signals(), tracked("reconstructing") as on_progress:
        samples = data_sets.quality_set(
            pipeline,
            uncertainty_model,
            data_sets.open_dataset(data, expected=True),
            objects,
            on_progress,
        )
    with interrupted_by_signals(), tracked("fitting the quality model") as on_progress:
        record = training.run_quality(weights, samples, on_progress)
    values = {name: value for name, value in record.figures.items() if name.startswith("all_")}
    text = f"quality model beside {weights}; on kinds left out: {_values(values)}"
    trusted = {"trusted_above": record.trusted_above}
    finish(
        {"weights": str(weights), "objects": record.objects, **trusted, **record.figures},
        as_json=json,
        text=text,
    )


def _values(figures: training.Scores) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
