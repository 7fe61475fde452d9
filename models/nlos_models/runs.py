"""Training runs: starting weights, run folder and record, and one function per task that trains and saves."""

from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from lightning_fabric import Fabric

from nlos_models.arrays import Float16
from nlos_models.checkpoint import (
    RECORD,
    CheckpointRecord,
    load_encoder,
    load_pipeline,
    load_pipeline_partly,
    load_record,
    load_vae,
    save_pipeline,
    save_vae,
    shipped_folder,
)
from nlos_models.data import MapSet, MapSource
from nlos_models.doubt_checkpoint import DoubtRecord, save_doubt
from nlos_models.doubt_training import DoubtSet, calibrated, train_doubt
from nlos_models.errors import OutputExistsError, TrainingError
from nlos_models.pipeline import RemappingNetwork, new_vae
from nlos_models.recipe import SIMULATION_ONLY, Recipe
from nlos_models.tasks import Start, figures_of, run, train_compressor, train_transfer, train_vae
from nlos_models.train import OnStep, Running
from nlos_models.vae import Encoder, ResVae

Figures = dict[str, float]


@contextmanager
def unwatched(fabric: Fabric, training: "TrainingRun", name: str) -> Generator[tuple[OnStep, Running]]:
    """Run without progress, to its end."""
    del name
    yield lambda _done, _total: None, training.running(fabric)


Watch = Callable[[Fabric, "TrainingRun", str], AbstractContextManager[tuple[OnStep, Running]]]
"""Opens progress and interruption for a run of this name, in each of its processes; has to be picklable."""


@dataclass(frozen=True)
class TrainingRun:
    """Everything that a task needs beside its data."""

    recipe: Recipe
    out: Path
    record: CheckpointRecord
    """Record of the weights to be made, still without figures."""
    tensorboard: bool = False
    compiled: bool = False
    origin: str = ""
    """Digest of the starting weights and data; see `Running`."""
    watch: Watch = unwatched

    def with_figures(self, figures: Figures) -> CheckpointRecord:
        """Return the record with the held-out figures."""
        return self.record.model_copy(update={"figures": figures})

    def running(self, fabric: Fabric) -> Running:
        """Return how the run is run, without hooks."""
        return Running(fabric, tensorboard=self.tensorboard, compiled=self.compiled, origin=self.origin)


def new_record(recipe: Recipe, rig: tuple[str, str], before: list[Recipe]) -> CheckpointRecord:
    """Return the record of the weights that a recipe makes after earlier runs; `rig` is its (name, checksum)."""
    return CheckpointRecord.of([*before, recipe], rig, recipe.maps)


def check_run_folder(out: Path, record: CheckpointRecord, *starts: Path | None) -> None:
    """Raise OutputExistsError where a run into `out` would write over a file, its own start, or other weights."""
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"{out} is a file, but --out must be a run's directory: choose another --out")
    if out.resolve() in {start.resolve() for start in starts if start}:
        raise OutputExistsError(f"{out} holds the weights that this run starts from: choose another --out")
    if (out / RECORD).exists() and load_record(out).model_copy(update={"figures": {}}) != record:
        raise OutputExistsError(f"{out} holds weights from another run: choose another --out")


def run_vae(fabric: Fabric, training: TrainingRun, start: ResVae | None, images: Float16, held_out: Float16) -> Figures:
    """Train a VAE and save it; return its held-out figures."""
    with training.watch(fabric, training, "VAE") as (on_step, running):
        vae, figures = train_vae(training.recipe, images, held_out, training.out, on_step, running, start)
    if fabric.is_global_zero:
        save_vae(training.out, vae, training.with_figures(figures))
    return figures


def run_compressor(fabric: Fabric, training: TrainingRun, start: Start, maps: MapSource, held_out: MapSet) -> Figures:
    """Train a compressor and save it with its decoder; return its held-out figures."""
    with training.watch(fabric, training, "compressor") as (on_step, running):
        recipe = training.recipe
        pipeline, figures = train_compressor(recipe, start, maps, held_out, training.out, on_step, running)
    if fabric.is_global_zero:
        encoder = start.vae.encoder if start.vae and recipe.steps != "one" else None
        save_pipeline(training.out, pipeline, training.with_figures(figures), encoder)
    return figures


def run_transfer(
    fabric: Fabric,
    training: TrainingRun,
    pipeline: RemappingNetwork,
    encoder: Encoder | None,
    maps: MapSource,
    held_out: MapSet,
) -> dict[str, Figures]:
    """Fine-tune weights on recordings and save them; return their held-out figures before and after."""
    before = figures_of(run(pipeline.to(fabric.device).eval(), held_out), held_out.image)
    with training.watch(fabric, training, "transfer") as (on_step, running):
        pipeline, after = train_transfer(
            training.recipe, pipeline, encoder, maps, held_out, training.out, on_step, running
        )
    if fabric.is_global_zero:
        save_pipeline(training.out, pipeline, training.with_figures(after), encoder)
    return {"before": before, "after": after}


def run_doubt(
    fabric: Fabric,
    training: TrainingRun,
    about: DoubtRecord,
    watched: Path,
    samples: DoubtSet,
    held_out: DoubtSet,
) -> Figures:
    """Train, calibrate and save an uncertainty network beside the weights it watches; return its held-out figures."""
    with training.watch(fabric, training, "doubt network") as (on_step, running):
        network, figures = train_doubt(training.recipe, samples, held_out, training.out, on_step, running)
    fitted = calibrated(network, held_out)
    record = about.model_copy(update={**asdict(fitted), "figures": figures})
    if fabric.is_global_zero:
        save_doubt(training.out, network, record, watched)
    return {**figures, "error_scale": fitted.error_scale, "outside_above": fitted.outside_above}


def vae_start(recipe: Recipe, weights: Path | None) -> tuple[ResVae, list[Recipe]]:
    """Load the VAE that a recipe starts from (the shipped one unless named) and the runs that made it."""
    _check_same_color(recipe, weights)
    trained, record = load_vae(weights or shipped_folder())
    return trained, record.vae_runs


def compressor_start(recipe: Recipe, vae_folder: Path | None, weights: Path | None) -> tuple[Start, list[Recipe]]:
    """Load the networks that the recipe's steps start from, and the runs that made them; none for one step."""
    if recipe.steps == "one":
        return Start(), []
    if recipe.steps == "two":
        trained, vae_runs = vae_start(recipe, vae_folder)
        if recipe.start == "scratch":
            return Start(trained), vae_runs
        pipeline, runs = _pipeline_start(recipe, weights)
        return Start(trained, pipeline), [*(run for run in runs if run not in vae_runs), *vae_runs]
    pipeline, runs = _pipeline_start(recipe, weights)
    trained = new_vae(colour=recipe.colour)
    if encoder := load_encoder(weights):
        trained.encoder = encoder
    elif recipe.latent_weight:
        raise TrainingError(f"{weights} has no encoder to aim at: set latent_weight = 0 in the recipe")
    trained.decoder = pipeline.decoder
    return Start(trained, pipeline), runs


def transfer_start(
    recipe: Recipe, weights: Path | None, *, partial: bool, on_report: Callable[[str], None]
) -> tuple[RemappingNetwork, list[Recipe]]:
    """Load the pipeline that a transfer starts from, and the runs that made it.

    If `partial`, only matching layers are loaded, `on_report` is called with a summary of them, and the others are
    initialised from the recipe's seed.
    """
    _check_fits(recipe, weights)
    torch.manual_seed(recipe.seed)
    if partial:
        pipeline, record, report = load_pipeline_partly(weights or shipped_folder())
        on_report(f"compressor: {report}")
    else:
        pipeline, record = load_pipeline(weights)
    return pipeline, record.runs


def _pipeline_start(recipe: Recipe, weights: Path | None) -> tuple[RemappingNetwork, list[Recipe]]:
    _check_fits(recipe, weights)
    pipeline, record = load_pipeline(weights)
    return pipeline, record.runs


def _check_fits(recipe: Recipe, folder: Path | None) -> None:
    record = _check_same_color(recipe, folder)
    if record.input != recipe.maps:
        raise TrainingError(
            f"weights expect {record.input} but the recipe uses {recipe.maps}: choose a matching pair of --weights and "
            "--recipe"
        )
    if recipe.task == "compressor" and record.width != recipe.width:
        raise TrainingError(
            f"weights have width {record.width:g} but the recipe asks for {recipe.width:g}: choose a matching pair of "
            "--weights and --recipe"
        )


def _check_same_color(recipe: Recipe, folder: Path | None) -> CheckpointRecord:
    """Return the weights' record; raise TrainingError unless weights and recipe are both of depth or both in color."""
    record = load_record(folder or shipped_folder())
    if record.colour != recipe.colour:
        holds, wants = (f"colour ({SIMULATION_ONLY})" if one.colour else "depth" for one in (record, recipe))
        raise TrainingError(
            f"{folder or 'the shipped folder'} holds weights for {holds} but the recipe is for {wants}: name others "
            "with --vae or --weights"
        )
    return record
