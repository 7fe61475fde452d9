"""Verdicts of a bench's own weights: their uncertainty network, and their quality model."""

from pathlib import Path

import nlos_models as models
from nlos_models import training

from nlos_cam import dataset as data
from nlos_cam.adapt.job import (
    HELD_OUT,
    JUDGED,
    NETWORK,
    OUTLIERS,
    QUALITY,
    SHARE_GENERIC,
    WEIGHTS,
    Adaptation,
    is_whole,
    render_set,
)
from nlos_cam.adapt.plan import HELD_OUT_OBJECTS, Plan
from nlos_cam.errors import SceneError
from nlos_cam.files import (
    atomic_directory,
    cache_folder,
    checksums_of,
    damaged_files,
    write_checked,
)

UNCERTAINTY = "uncertainty"
QUALITY_SEED = 40_000_000
JUDGED_SEED = 35_000_000
"""First seeds of the objects that the quality model and the uncertainty network are fitted to:
neither a bench's network nor shipped weights were trained on these."""
QUALITY_OBJECTS = 600, 6000
"""Objects that the quality model is fitted to, at least and at most."""
QUALITY_PER_MINUTE = 60
RECIPE = "doubt"


def train_uncertainty(
    job: Adaptation, plan: Plan, folder: Path, tracked: data.Tracked, watch: training.Watch | None
) -> None:
    """Train the uncertainty network of a network, fit its quality model, and put all three into
    WEIGHTS in one step, unless that is whole.
    """
    if is_whole(folder / WEIGHTS, models.UNCERTAINTY_ONNX):
        return

    network = folder / NETWORK
    uncertainty = folder / UNCERTAINTY  # gets copies of the network's files too
    if not is_whole(uncertainty, models.UNCERTAINTY_ONNX):
        _train_uncertainty_network(job, plan, network, uncertainty, tracked, watch)
    _fit_quality(job, plan, uncertainty, tracked)

    names = *checksums_of(network), *checksums_of(uncertainty)
    with atomic_directory(folder / WEIGHTS) as part:
        write_checked(part, {name: (uncertainty / name).read_bytes() for name in names})


def _train_uncertainty_network(
    job: Adaptation,
    plan: Plan,
    watched: Path,
    out: Path,
    tracked: data.Tracked,
    watch: training.Watch | None,
) -> None:
    """Train the uncertainty network of the weights in `watched`: on objects that these were not
    trained on, empty benches and outliers.
    """
    # A kill between its files, or damage: the training goes on or begins again, and writes them
    # again. Damaged copies of the network's files would pass for those of other weights.
    for name in (models.UNCERTAINTY_RECORD, *damaged_files(out)):
        (out / name).unlink(missing_ok=True)

    recipe = plan.uncertainty_recipe(_uncertainty_recipe())
    objects = render_set(job, JUDGED, JUDGED_SEED, recipe.objects, tracked)
    held_out = render_set(job, HELD_OUT, data.HELD_OUT_SEED, HELD_OUT_OBJECTS, tracked)
    sets = data.open_dataset(objects), data.open_dataset(held_out)
    pipeline = models.load_reconstructor(watched, cache_folder() / "onnx")
    data.check_uncertainty_data(recipe, pipeline, *sets)

    kinds = list(data.outliers_beside(SHARE_GENERIC))
    record = training.record_uncertainty_run(recipe, out, watched, kinds)
    with tracked("rendering empty benches and outliers") as on_progress:
        samples = data.uncertainty_sets(recipe, pipeline, sets, job.folder / OUTLIERS, on_progress)

    fabric = training.open_fabric(recipe, accelerator=job.accelerator)
    run = training.TrainingRun(
        recipe,
        out,
        pipeline.record,
        record.watches,
        watch=watch or training.unwatched,
    )
    training.run_uncertainty(fabric, run, record, watched, *samples)


def _fit_quality(job: Adaptation, plan: Plan, weights: Path, tracked: data.Tracked) -> None:
    """Fit the quality model beside weights and their uncertainty network: to objects on benches
    that are off their record, as a real one is.
    """
    at_least, at_most = QUALITY_OBJECTS
    count = min(max(round(QUALITY_PER_MINUTE * plan.minutes), at_least), at_most)
    objects = render_set(job, QUALITY, QUALITY_SEED, count, tracked, off_record=True)

    graphs = cache_folder() / "onnx"
    pipeline = models.load_reconstructor(weights, graphs)
    uncertainty = models.load_uncertainty_model(weights, graphs, quality=False)
    if uncertainty is None:
        raise SceneError(f"{weights} has no uncertainty network: delete it, and try again")

    with tracked("reconstructing objects for the quality model") as on_progress:
        found = data.quality_set(
            pipeline, uncertainty, data.open_dataset(objects), count, on_progress
        )
    with tracked("fitting the quality model") as on_progress:
        training.run_quality(weights, found, on_progress)


def _uncertainty_recipe() -> training.UncertaintyRecipe:
    recipe = training.load_recipe(training.packaged_recipes()[RECIPE])
    if not isinstance(recipe, training.UncertaintyRecipe):
        raise SceneError(f"{RECIPE} is no recipe of an uncertainty network")
    return recipe
