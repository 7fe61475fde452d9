"""`train doubt`: what a pipeline makes of ordinary objects, empty benches and outliers, to a network that doubts it."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from lightning_fabric import Fabric
from nlos_models.checkpoint import shipped_folder
from nlos_models.data import MapSet
from nlos_models.doubt_calibration import calibrated
from nlos_models.doubt_training import DoubtSet, train_doubt
from nlos_models.doubt_weights import DOUBT_RECORD, DoubtRecord, checksum_of_watched, save_doubt
from nlos_models.inference import Reconstructor, load_reconstructor
from nlos_models.processes import launched
from nlos_models.recipe import Recipe
from nlos_models.remap import parts_of
from nlos_models.sources import first_of

from nlos_cam import dataset
from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import finish, tracked
from nlos_cam.cli.train_data import HeldOut, Maps
from nlos_cam.cli.train_options import RunOptions
from nlos_cam.cli.train_runs import Figures, Job, watched_run
from nlos_cam.doubt_samples import EMPTY, ORDINARY, DoubtSamples, samples_on_disk
from nlos_cam.errors import OutputExistsError, SceneError
from nlos_cam.outliers import TO_LEARN

SAMPLES = "samples"
LEAST_CELLS = 8
"""An outlier that shows in fewer cells of the maps is not learnt from: it can hardly be told from nothing at all."""
HELD_OUT_SHARE = 0.15
"""Of outliers and empty benches, beside those that are learnt from."""


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
    training, judging = (dataset.open_dataset(folder) for folder in (data, held_out_data))
    _check(recipe, pipeline, training, judging)
    about = DoubtRecord(watches=checksum_of_watched(watched), recipe=recipe, learnt=list(TO_LEARN))
    if run.out.resolve() == watched.resolve() or (run.out / DOUBT_RECORD).exists():
        raise OutputExistsError(f"{run.out} holds weights already: choose another --out")
    counts = counts_of(recipe)
    fewer = {kind: round(HELD_OUT_SHARE * count) for kind, count in counts.items()}
    sets = [
        _whole_set(pipeline, first_of(maps.arrays(), most), _made(run.out / SAMPLES, some, seed, maps.plan))
        for maps, most, some, seed in (
            (training, recipe.objects, counts, dataset.TRAINING_SEED),
            (judging, recipe.held_out, fewer, dataset.HELD_OUT_SEED),
        )
    ]
    job = Job(recipe, run.out, pipeline.record, run.tensorboard, run.compiled, about.watches)
    figures = launched(fabric, run_doubt, job, about, watched, *sets)
    finish({"out": str(run.out), **figures}, as_json=run.json, text=f"weights with their doubt in {run.out}: {figures}")


def counts_of(recipe: Recipe) -> dict[str, int]:
    """How many samples are rendered of each kind.

    On benches that lie slightly off, as many ordinary objects as outliers: else what lies off would itself be a sign.
    """
    of_each = dict.fromkeys(TO_LEARN, recipe.outliers)
    return {EMPTY: recipe.empties, ORDINARY: sum(of_each.values()) // 2, **of_each}


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


def doubt_set(pipeline: Reconstructor, samples: DoubtSamples) -> DoubtSet:
    """Samples beside what a pipeline makes of them."""
    outside = (samples.kind != EMPTY) & (samples.kind != ORDINARY)
    made = _images(pipeline, MapSet(samples.depth_m, samples.intensity, samples.image))
    return DoubtSet(samples.depth_m, samples.intensity, made, samples.image, samples.kind == EMPTY, outside)


def _whole_set(pipeline: Reconstructor, usual: MapSet, samples: DoubtSamples) -> DoubtSet:
    """Ordinary maps of a dataset, and the samples that can be seen."""
    made = doubt_set(pipeline, samples)
    made = made.where((samples.cells >= LEAST_CELLS) | made.nothing)
    of_dataset, no = _images(pipeline, usual), np.zeros(len(usual.image), np.bool_)
    ordinary = DoubtSet(usual.depth_m, usual.intensity, of_dataset, usual.image.astype(np.float16), no, no)
    pairs = {name: (values, vars(made)[name]) for name, values in vars(ordinary).items()}
    return DoubtSet(**{name: np.concatenate(pair) for name, pair in pairs.items()})


def _images(pipeline: Reconstructor, maps: MapSet) -> np.ndarray:
    pairs = zip(parts_of(maps.depth_m), parts_of(maps.intensity), strict=True)
    return np.concatenate([pipeline(*pair) for pair in pairs]).astype(np.float16)


def _made(folder: Path, counts: dict[str, int], seed: int, plan: dataset.DatasetPlan) -> DoubtSamples:
    with tracked("rendering empty benches and outliers") as on_progress:
        return samples_on_disk(
            folder, counts, seed, plan.rig, plan.sensor, accuracy=plan.accuracy, on_progress=on_progress
        )


def _check(recipe: Recipe, pipeline: Reconstructor, training: dataset.Dataset, judging: dataset.Dataset) -> None:
    if pipeline.record.input != "raw maps":
        raise SceneError(f"these weights eat {pipeline.record.input}, and doubt is learnt of raw maps: name others")
    if not training.plan.rig.checksum == judging.plan.rig.checksum == pipeline.record.rig_checksum:
        raise SceneError("maps, held-out maps and weights are not all of one rig: name others, or build the maps again")
    if len(training) < recipe.objects:
        told = f"the dataset holds {len(training)} objects, the recipe asks for {recipe.objects}"
        raise SceneError(f"{told}: build that many, or give --objects")
