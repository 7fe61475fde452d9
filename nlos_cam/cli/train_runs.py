"""What `train` runs in each of its processes: one job from data in memory to weights on the disk."""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lightning_fabric import Fabric
from nlos_calibration.arrays import Float16
from nlos_calibration.rig import Rig
from nlos_models.checkpoint import RECORD, load_record, save_pipeline, save_vae
from nlos_models.data import MapSet
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import SIMULATION_ONLY, Recipe
from nlos_models.record import CheckpointRecord
from nlos_models.remap import figures_of, run
from nlos_models.res_vae import Encoder, ResVae
from nlos_models.sources import MapSource
from nlos_models.tasks import Start, train_compressor, train_vae
from nlos_models.train import OnStep, Running
from nlos_models.transfer import train_transfer

from nlos_cam.cli.common import progress, say, stop_on_signals
from nlos_cam.cli.train import RunOptions
from nlos_cam.errors import OutputExistsError

Figures = dict[str, float]


@dataclass(frozen=True)
class Job:
    """What every task needs beside its data."""

    recipe: Recipe
    out: Path
    record: CheckpointRecord
    """Of the weights to be, but for their figures."""
    tensorboard: bool = False
    compiled: bool = False
    origin: str = ""
    """See `Running`."""

    def made(self, figures: Figures) -> CheckpointRecord:
        """The record with the figures in."""
        return self.record.model_copy(update={"figures": figures})


def job_of(run: RunOptions, recipe: Recipe, rig: Rig, before: list[Recipe], origin: str, *starts: Path | None) -> Job:
    """The job of a recipe after earlier runs. Raises OutputExistsError where it would write over other weights."""
    if run.out.exists() and not run.out.is_dir():
        raise OutputExistsError(f"{run.out} is a file, not a run's folder: choose another --out")
    if run.out.resolve() in {start.resolve() for start in starts if start}:
        raise OutputExistsError(f"{run.out} is where this run starts from: choose another --out")
    record = CheckpointRecord.of([*before, recipe], (rig.name, rig.checksum), recipe.maps)
    if (run.out / RECORD).exists() and load_record(run.out).model_copy(update={"figures": {}}) != record:
        raise OutputExistsError(f"{run.out} holds weights that another run made: choose another --out")
    return Job(recipe, run.out, record, run.tensorboard, run.compiled, origin)


def run_vae(fabric: Fabric, job: Job, start: ResVae | None, images: Float16, held_out: Float16) -> Figures:
    """Train a VAE and save it; its held-out figures."""
    with watched_run(fabric, job, "VAE") as (on_step, running):
        vae, figures = train_vae(job.recipe, images, held_out, job.out, on_step, running, start)
    if fabric.is_global_zero:
        save_vae(job.out, vae, job.made(figures))
    return figures


def run_compressor(fabric: Fabric, job: Job, start: Start, maps: MapSource, held_out: MapSet) -> Figures:
    """Train a compressor and save it with its decoder; its held-out figures."""
    with watched_run(fabric, job, "compressor") as (on_step, running):
        pipeline, figures = train_compressor(job.recipe, start, maps, held_out, job.out, on_step, running)
    if fabric.is_global_zero:
        encoder = start.vae.encoder if start.vae and job.recipe.steps != "one" else None
        save_pipeline(job.out, pipeline, job.made(figures), encoder)
    return figures


def run_transfer(
    fabric: Fabric, job: Job, pipeline: Pipeline, encoder: Encoder | None, maps: MapSource, held_out: MapSet
) -> dict[str, Figures]:
    """Train weights on, on recordings, and save them; their held-out figures before and after."""
    before = figures_of(run(pipeline.to(fabric.device).eval(), held_out), held_out.image)
    with watched_run(fabric, job, "transfer") as (on_step, running):
        pipeline, after = train_transfer(job.recipe, pipeline, encoder, maps, held_out, job.out, on_step, running)
    if fabric.is_global_zero:
        save_pipeline(job.out, pipeline, job.made(after), encoder)
    return {"before": before, "after": after}


@contextmanager
def watched_run(fabric: Fabric, job: Job, what: str) -> Generator[tuple[OnStep, Running]]:
    """A run's progress bar, of the leading process; Ctrl-C or a request to terminate ends it after the step, saved."""
    with progress() as bar, stop_on_signals() as stop:
        what += f" in colour ({SIMULATION_ONLY})" if job.recipe.colour else ""
        task = bar.add_task(f"training the {what}", total=None, visible=fabric.is_global_zero)

        def on_step(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        def on_epoch(row: Figures) -> None:
            told = f"epoch {row['epoch'] + 1:.0f} done, loss {row['loss']:.4g}, held out {row['held_out_loss']:.4g}"
            bar.update(task, description=f"training the {what}: {told}")

        options = {name: getattr(job, name) for name in ("tensorboard", "compiled", "origin")}
        yield on_step, Running(fabric, stop.is_set, say, on_epoch, **options)
