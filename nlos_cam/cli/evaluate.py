"""`evaluate`: weights to figures, on objects never trained on."""

import time
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.inference import load_reconstructor

from nlos_cam import dataset
from nlos_cam import evaluate as judging
from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, tracked
from nlos_cam.errors import SceneError
from nlos_cam.objects.depth_image import FARTHEST_V


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("evaluate")(evaluate)


def evaluate(
    out: Annotated[Path, typer.Option("--out", help="A folder for figures and the contact sheet.")],
    data: Annotated[
        Path | None, typer.Option("--dataset", help="Judge on these maps, not on the test objects.")
    ] = None,
    training: Annotated[
        Path | None, typer.Option("--training", help="Training maps, for the nearest neighbour.")
    ] = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Other weights than the shipped ones.")] = None,
    count: Annotated[int, typer.Option("--count", min=1, help="Test objects to render.")] = 240,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Judge the reconstruction on objects never trained on, beside the trivial baselines."""
    folder, started = output_path(out, "evaluation", "", overwrite=overwrite), time.perf_counter()
    reconstructor = load_reconstructor(weights, cache_folder() / "onnx")
    if reconstructor.record.input != "raw maps":
        raise SceneError(
            f"these weights eat {reconstructor.record.input}, and datasets hold raw maps: use other weights"
        )
    plan = dataset.DatasetPlan(rig_named(reconstructor.record.rig_name), dataset.TEST_SEED)
    if data:
        maps, plan = dataset.read(data)
    else:
        with tracked("rendering test objects") as on_progress:
            maps = judging.sense_test_objects(plan.rig, plan.box, plan.first_seed, count, on_progress)
    trained_on = dataset.procedural_images(dataset.TRAINING_SEED, 2000, plan.box)
    guesses = judging.baselines(maps, trained_on, dataset.read(training)[0] if training else None)
    mm_per_v = 1000 * (plan.box.z_far_m - plan.box.z_near_m) / (1 - FARTHEST_V)
    truth, image = maps.image.astype(np.float32), judging.reconstruct_all(reconstructor, maps)
    figures = {name: asdict(value) for name, value in judging.judge(image, truth, mm_per_v).items()}
    trivial = {
        name: {metric: asdict(value) for metric, value in judging.judge(guess, truth, mm_per_v).items()}
        for name, guess in guesses.items()
    }
    result = {**figures, "baselines": trivial, "objects": len(truth), "seconds": time.perf_counter() - started}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "figures.json").write_text(dumps(result, indent=2) + "\n", encoding="utf-8")
    judging.draw_sheet(folder / "sheet.png", image, truth)
    iou = figures["silhouette_iou"]
    text = (
        f"silhouette IoU {iou['value']:.3f} ({iou['low']:.3f} to {iou['high']:.3f}) on {len(truth)} objects: {folder}"
    )
    finish({**result, "out": str(folder)}, as_json=json, text=text)
