"""`evaluate`: weights to figures and pictures, on objects never trained on."""

import os
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from nlos_calibration.rig import Rig
from nlos_calibration.wall_record import rig_named
from nlos_models.data import Half, MapSet
from nlos_models.inference import load_reconstructor

from nlos_cam import dataset
from nlos_cam import evaluate_baselines as trivial
from nlos_cam import evaluate_objects as objects
from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import Json, Overwrite, finish, interrupted_by_signals, output_path, tracked
from nlos_cam.errors import SceneError
from nlos_cam.evaluate_report import Judgement, as_figures, in_words, write
from nlos_cam.frames import Float32
from nlos_cam.objects.test_set import test_set

SHIPPED = "the shipped ones"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("evaluate")(evaluate)


def evaluate(
    out: Annotated[Path | None, typer.Option("--out", help="A folder for report, figures and pictures.")] = None,
    data: Annotated[
        Path | None, typer.Option("--dataset", help="Judge on these maps, not on the 54 test objects.")
    ] = None,
    training: Annotated[
        Path | None,
        typer.Option("--training", help="Training maps for the nearest neighbour, instead of rendered ones."),
    ] = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Other weights than the shipped ones.")] = None,
    rig: Annotated[
        str | None, typer.Option("--rig", help="Another rig than the weights' own, by name or file.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Judge on so many random objects, not on the 54.")
    ] = None,
    no_nearest: Annotated[
        bool, typer.Option("--no-nearest", help="Leave out the nearest neighbour: saves rendering 2000 objects once.")
    ] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Judge the reconstruction on objects never trained on, beside the trivial baselines."""
    if data and (count or rig):
        raise typer.BadParameter("--dataset brings its own objects and rig: leave out --count and --rig")
    folder, started = output_path(out, "evaluation", "", overwrite=overwrite), time.perf_counter()
    reconstructor = load_reconstructor(weights, cache_folder() / "onnx")
    record = reconstructor.record
    if record.input != "raw maps":
        raise SceneError(f"these weights eat {record.input}, and test maps are raw maps: use other weights")
    with interrupted_by_signals():
        if data:
            names, categories, maps, plan = _stored(data)
        else:
            plan = dataset.DatasetPlan(rig_named(rig or record.rig_name), dataset.TEST_SEED)
            names, categories, maps = _test_objects(plan.rig, count)
        images, training_maps = _training_set(plan, training, no_nearest=no_nearest)
        truth = maps.image.astype(np.float32)
        image = objects.reconstruct_all(reconstructor, maps)
    facts = {
        "what": f"Maps of {data}" if data else "Test objects never trained on, through the sensor's noise",
        "weights": str(weights or SHIPPED),
        "rig": plan.rig.name,
        "runtime": reconstructor.runtime,
    }
    judgement = Judgement(
        names, categories, truth, image, trivial.baselines(maps, images, training_maps), plan.box, facts
    )
    figures: dict[str, Any] = as_figures(judgement) | {"seconds": time.perf_counter() - started}
    write(folder, judgement, figures)
    text = f"silhouette IoU {in_words(figures['silhouette_iou'])} on {len(truth)} objects: {folder / 'report.md'}"
    finish({**figures, "out": str(folder)}, as_json=json, text=text)


def _test_objects(rig: Rig, count: int | None) -> tuple[list[str], list[str], MapSet]:
    """Names, categories and maps of the 54, or of so many random objects."""
    box = dataset.DatasetPlan(rig, dataset.TEST_SEED).box
    subjects = objects.seeded_objects(dataset.TEST_SEED, count, box) if count else test_set(box)
    with tracked("rendering test objects") as on_progress:
        echoes = objects.echoes_of(subjects, rig, on_progress)
    maps = objects.as_map_set(objects.sense(echoes, rig), objects.truth_of(subjects, box))
    return [subject.name for subject in subjects], [subject.category for subject in subjects], maps


def _stored(folder: Path) -> tuple[list[str], list[str], MapSet, dataset.DatasetPlan]:
    """Names, categories and maps of a dataset, and its plan."""
    opened = dataset.open_dataset(folder)
    categories = [str(category) for category in opened.column("category")]
    names = [f"{category} {seed}" for category, seed in zip(categories, opened.column("seed"), strict=True)]
    return names, categories, opened.arrays(), opened.plan


def _training_set(
    plan: dataset.DatasetPlan, training: Path | None, *, no_nearest: bool
) -> tuple[Half | Float32, MapSet | None]:
    """The images whose mean is a baseline, and the maps to find the nearest neighbour among, if it is wanted."""
    if no_nearest:
        return dataset.procedural_images(dataset.TRAINING_SEED, trivial.NEIGHBOURS, plan.box), None
    if training:
        maps = dataset.read(training)[0]
    else:
        with tracked("rendering training objects for the nearest neighbour, once") as on_progress:
            maps = trivial.training_maps(plan, cache_folder(), os.cpu_count() or 1, on_progress)
    return maps.image, maps
