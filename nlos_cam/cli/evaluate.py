"""The command `evaluate`: weights to figures and pictures, on held-out objects."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from nlos_cam import evaluate as measure
from nlos_cam.cli import benches
from nlos_cam.cli.common import (
    Json,
    Overwrite,
    finish,
    interrupted_by_signals,
    output_path,
    say,
    tracked,
)
from nlos_cam.errors import RecordingError

Count = Annotated[
    int | None,
    typer.Option(
        "--count", min=1, help="Number of random objects, instead of the 54 test objects."
    ),
]


def evaluate(
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the report, figures and pictures.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option("--dataset", help="Evaluate on these maps instead of the 54 test objects."),
    ] = None,
    training: Annotated[
        Path | None,
        typer.Option(
            "--training", help="Training maps for the nearest neighbour (default: rendered)."
        ),
    ] = None,
    weights: benches.Weights = None,
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig",
            help="Rig by name or file (default: that of the weights; of those for any, the paper's).",
        ),
    ] = None,
    wall: Annotated[
        Path | None,
        typer.Option(
            "--wall", help="Bare wall for difference maps, wall.toml (default: rendered)."
        ),
    ] = None,
    bench_folder: benches.BenchOrRig = None,
    count: Count = None,
    no_nearest: Annotated[
        bool,
        typer.Option(
            "--no-nearest", help="Omit the nearest neighbour, which renders 2000 objects once."
        ),
    ] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Measure weights on held-out objects, beside trivial baselines."""
    if data and (count or rig or bench_folder):
        raise typer.BadParameter(
            "--dataset has its own objects and rig: omit --count, --rig and --bench"
        )
    if training and no_nearest:
        raise typer.BadParameter(
            "--training is searched for the nearest neighbour: omit it or --no-nearest"
        )
    if data and training and data.resolve() == training.resolve():
        raise typer.BadParameter(
            f"--dataset and --training are the same folder ({data}): each object would be its own"
            " nearest neighbour"
        )
    # Before what takes seconds to import.
    for option, given in (("--dataset", data), ("--training", training)):
        if given and not given.exists():
            raise RecordingError(
                f"{option} {given} does not exist: make one with `nlos-cam dataset build`"
            )
    its_rig = benches.rig_of(bench_folder, rig)
    if bench_folder:
        weights = benches.choose(bench_folder, wall, weights).weights
    folder = output_path(out, "evaluation", "", overwrite=overwrite)
    start_s = time.perf_counter()
    with interrupted_by_signals():
        evaluation = measure.evaluate(
            weights,
            data,
            rig=its_rig,
            count=count,
            wall=wall,
            training=training,
            nearest=not no_nearest,
            tracked=tracked,
        )
    for note in evaluation.facts["notes"]:
        say(f"note: {note}")
    figures: dict[str, Any] = measure.as_figures(evaluation) | {
        "seconds": time.perf_counter() - start_s
    }
    measure.write_report(folder, evaluation, figures)
    iou = measure.format_interval(figures["silhouette_iou"])
    text = f"Silhouette IoU {iou} on {figures['objects']} objects: open {folder / measure.REPORT}"
    finish({**figures, "out": str(folder)}, as_json=json, text=text)
