"""The command `adapt`: from a calibrated bench to weights of its own."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from nlos_cam import adapt as adaptation
from nlos_cam import bench as benches
from nlos_cam import evaluate as evaluation
from nlos_cam.cli import common
from nlos_cam.cli.benches import bench_or_rig
from nlos_cam.cli.train import watched_run
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import checksums_of

PAGE = "adapt.html"
WORK = "adapt"
WEIGHTS = "weights"


def adapt(
    bench: Annotated[
        str,
        typer.Argument(
            metavar="BENCH", help="Bench folder, wall record, rig file or name of a packaged rig."
        ),
    ],
    minutes: Annotated[
        float,
        typer.Option(
            "--minutes", min=1, max=6000, help="Minutes of work in all; more go on from fewer."
        ),
    ] = 10.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the work and the weights (default: in the bench)."),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", help="Start weights (default: the shipped direct ones)."),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option("--ray", help="Ray cluster that renders: auto, HOST:PORT, local."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Processes that render (default: all cores but one)."
        ),
    ] = None,
    accelerator: Annotated[
        Literal["auto", "cpu", "cuda"],
        typer.Option("--accelerator", help="Device of the training; auto: a GPU if there is one."),
    ] = "auto",
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Make weights for one bench: render objects for exactly its rig, and train on meanwhile.

    Killed at any moment, the same command goes on. More --minutes go on from what is there.
    """
    folder = Path(bench) if out is None and Path(bench).is_dir() else None
    rig, measured = bench_or_rig(bench)
    home = out or folder or Path(f"adapted-{rig.name}")
    target = home / WEIGHTS
    work = home / WORK
    if not overwrite:
        _refuse_others(target, work)
    optional: dict[str, Any] = {}
    if workers:
        optional["workers"] = workers
    if ray:
        from nlos_cam.dataset import ray_farm

        optional["farm"] = ray_farm(ray)
    job = adaptation.Adaptation(
        rig,
        adaptation.calibration_spread(measured),
        work,
        weights,
        adaptation.bench_sensor(measured),
        accelerator=accelerator,
        **optional,
    )

    @cache
    def test_objects() -> evaluation.HeldOutObjects:
        """Render the test objects once, for the start weights and for the new ones."""
        return evaluation.rendered_objects(rig, tracked=common.tracked, sensor=job.sensor)

    def measure(start: Path | None, folder: Path) -> None:
        found = evaluation.evaluate(start, test_objects(), nearest=False, tracked=common.tracked)
        evaluation.write_report(folder, found, evaluation.as_figures(found))

    try:
        result = adaptation.adapt(
            job, minutes, measure, tracked=common.tracked, watch=watched_run, on_message=common.say
        )
    except KeyboardInterrupt:
        common.exit_interrupted(f"what was made is kept in {work}; give the same command to go on")
    if folder:
        benches.write_weights(folder, result.weights, result.after["silhouette_iou"]["value"])
    else:
        adaptation.install(result.weights, target)

    rows = [
        (
            evaluation.LABELS[metric],
            evaluation.format_interval(result.before[metric]),
            evaluation.format_interval(result.after[metric]),
        )
        for metric in evaluation.TARGETS
    ]
    page = work / PAGE
    adaptation.write_page(result, rows, page)
    _, before, after = rows[0]
    state = "was finished before" if result.was_there else "done"
    text = (
        f"{state}: {rows[0][0]} {before} -> {after} on this bench; weights in {target}, report"
        f" {page}"
    )
    facts = {
        "out": str(target),
        "report": str(page),
        "minutes": result.plan.minutes,
        "objects": result.plan.stages[-1].objects,
        "before": result.before,
        "after": result.after,
    }
    common.finish(facts, as_json=json, text=text)


def _refuse_others(target: Path, work: Path) -> None:
    """Raise OutputExistsError where the bench has weights that no adaptation in `work` made."""
    if not target.exists():
        return
    # the network's file: a bench adds its rig to the record
    ours = [
        checksums_of(folder).get(adaptation.NETWORK_FILE)
        for folder in work.glob(f"stage-*/{WEIGHTS}")
    ]
    if checksums_of(target).get(adaptation.NETWORK_FILE, "") not in ours:
        raise OutputExistsError(
            f"{target} holds weights that were not made here: move them, or give --overwrite"
        )
