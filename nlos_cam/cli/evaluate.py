"""`evaluate`: weights to figures and pictures, on objects never trained on."""

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from nlos_calibration import rig_named
from nlos_models import load_reconstructor

from nlos_cam.cli.common import Json, Overwrite, finish, interrupted_by_signals, output_path, say, tracked
from nlos_cam.evaluate import (
    Judgement,
    as_eaten,
    as_figures,
    bare_wall_for,
    baseline_images,
    fresh_objects,
    in_words,
    left_out_of,
    notes_on,
    reconstruct_all,
    rig_of,
    stored_objects,
    write,
)
from nlos_cam.files import cache_folder

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
    wall: Annotated[
        Path | None,
        typer.Option("--wall", help="The bare wall for difference maps (wall.toml); else it is rendered."),
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
    if training and no_nearest:
        raise typer.BadParameter("--training is what the nearest is looked for in: leave out --no-nearest")
    folder, started = output_path(out, "evaluation", "", overwrite=overwrite), time.perf_counter()
    reconstructor = load_reconstructor(weights, cache_folder() / "onnx")
    record = reconstructor.record
    with interrupted_by_signals():
        if data:
            judged = stored_objects(data)
        else:
            judged = fresh_objects(rig_named(rig) if rig else rig_of(record), count, tracked)
        bare = bare_wall_for(record, judged.plan, wall)
        guesses, among = baseline_images(judged, training, nearest=not no_nearest, tracked=tracked)
        image = reconstruct_all(reconstructor, as_eaten(judged.maps, bare))
    notes = notes_on(record, judged, among)
    for note in notes:
        say(f"note: {note}")
    facts = {
        "what": judged.what,
        "weights": str(weights or SHIPPED),
        "rig": judged.plan.rig.name,
        "runtime": reconstructor.runtime,
        "input": record.input,
        "training_objects": len(among) if among else None,
        "notes": notes,
    }
    truth = judged.maps.image.astype(np.float32)
    left_out = left_out_of(record)
    judgement = Judgement(judged.names, judged.categories, truth, image, guesses, judged.plan.box, facts, left_out)
    figures: dict[str, Any] = as_figures(judgement) | {"seconds": time.perf_counter() - started}
    write(folder, judgement, figures)
    text = f"silhouette IoU {in_words(figures['silhouette_iou'])} on {len(truth)} objects: {folder / 'report.md'}"
    finish({**figures, "out": str(folder)}, as_json=json, text=text)
