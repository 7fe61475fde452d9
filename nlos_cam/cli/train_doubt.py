"""`train doubt`: what a pipeline makes of ordinary objects, empty benches and outliers, to a network that doubts it."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from lightning_fabric import Fabric
from nlos_models.checkpoint import shipped_folder
from nlos_models.doubt_calibration import calibrated
from nlos_models.doubt_training import DoubtSet, train_doubt
from nlos_models.doubt_weights import DOUBT_RECORD, DoubtRecord, checksum_of_watched, save_doubt
from nlos_models.inference import load_reconstructor
from nlos_models.processes import launched
from nlos_models.sources import first_of

from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import finish
from nlos_cam.cli.train_options import HeldOut, Maps, RunOptions
from nlos_cam.cli.train_runs import Figures, Job, watched_run
from nlos_cam.dataset import build
from nlos_cam.dataset.doubt_samples import HELD_OUT_SHARE, _check, _made, _whole_set, counts_of
from nlos_cam.dataset.outliers import TO_LEARN
from nlos_cam.errors import OutputExistsError

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
    training, judging = (build.open_dataset(folder) for folder in (data, held_out_data))
    _check(recipe, pipeline, training, judging)
    about = DoubtRecord(watches=checksum_of_watched(watched), recipe=recipe, learnt=list(TO_LEARN))
    if run.out.resolve() == watched.resolve() or (run.out / DOUBT_RECORD).exists():
        raise OutputExistsError(f"{run.out} holds weights already: choose another --out")
    counts = counts_of(recipe)
    fewer = {kind: round(HELD_OUT_SHARE * count) for kind, count in counts.items()}
    sets = [
        _whole_set(pipeline, first_of(maps.arrays(), most), _made(run.out / SAMPLES, some, seed, maps.plan))
        for maps, most, some, seed in (
            (training, recipe.objects, counts, build.TRAINING_SEED),
            (judging, recipe.held_out, fewer, build.HELD_OUT_SEED),
        )
    ]
    job = Job(recipe, run.out, pipeline.record, run.tensorboard, run.compiled, about.watches)
    figures = launched(fabric, run_doubt, job, about, watched, *sets)
    finish({"out": str(run.out), **figures}, as_json=run.json, text=f"weights with their doubt in {run.out}: {figures}")


def run_doubt(
    fabric: Fabric, job: Job, about: DoubtRecord, watched: Path, training: DoubtSet, held_out: DoubtSet
) -> Figures:
    """Train, calibrate and save a doubt network; its held-out figures."""
    with watched_run(fabric, job, "doubt network") as (on_step, running):
        network, figures = train_doubt(job.recipe, training, held_out, job.out, on_step, running)
    fitted = calibrated(network, held_out)
    record = about.model_copy(update={**asdict(fitted), "figures": figures})
    if fabric.is_global_zero:
        save_doubt(job.out, network, record, watched)
    return {**figures, "error_scale": fitted.error_scale, "outside_above": fitted.outside_above}
