"""The commands `tradeoff render` and `tradeoff reconstruct`: accuracy against time, measured on
this machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from nlos_cam import evaluate as measure
from nlos_cam import render as renderer
from nlos_cam.cli import common
from nlos_cam.cli.evaluate import Count
from nlos_cam.cli.render import hidden_depth
from nlos_cam.files import cache_folder

R = TypeVar("R")
Out = Annotated[Path | None, typer.Option("--out", help="Folder for the table and the plot.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    tradeoff = typer.Typer(help="Measure accuracy against time, of rendering or reconstruction.")
    tradeoff.command("render")(render)
    tradeoff.command("reconstruct")(reconstruct)
    app.add_typer(tradeoff, name="tradeoff")


def render(
    out: Out = None,
    category: Annotated[
        str | None,
        typer.Option(
            "--object", help="Category, mesh or depth map to hide (default: an airplane)."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Variation of the category.")
    ] = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Measure the renderer's accuracy stops and their ingredients against brute force (about 30
    s).
    """
    if seed is not None and category is None:
        raise typer.BadParameter("--seed is the variation of an --object: give both")
    folder = common.output_path(out, "tradeoff", "", overwrite=overwrite)
    scene = _scene(category, seed or 0)
    size = measure.render_facts(scene)
    planned = len(measure.render_settings(scene))
    rows: list[measure.RenderRow] = []
    common.say("Rendering the reference first (slowest step, about 30 s)")
    interrupted = _collect(measure.measure_renders(scene), rows, planned)
    table = measure.as_table(size, rows, planned)
    if rows:
        measure.write_renders(folder, table, rows, category or "airplane")
    _finish(table, folder, len(rows), planned, as_json=json, interrupted=interrupted)


def reconstruct(
    out: Out = None,
    weights: Annotated[
        list[Path] | None,
        typer.Option(
            "--weights",
            help=(
                "Folder of weights, direct, wide, any or paper, each measured on its own rig (any on"
                " the paper's); repeat to compare (default: direct and paper)."
            ),
        ),
    ] = None,
    count: Count = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Measure networks, with 1 to 64 averaged frames, on the test objects and on kinds never seen
    (two minutes).
    """
    folder = common.output_path(out, "tradeoff", "", overwrite=overwrite)
    networks = {str(path): path for path in weights} if weights else measure.NETWORKS
    rows: list[measure.ReconstructRow] = []
    with common.interrupted_by_signals():
        common.say("Loading networks and rendering test objects first")
        bench = measure.open_reconstruct_bench(
            networks, cache_folder() / "onnx", count, common.tracked
        )
    asked = measure.reconstruct_settings(bench)
    interrupted = _collect(measure.measure_reconstructions(asked, bench), rows, len(asked))
    table = measure.reconstruct_facts(rows, len(asked), bench.objects, measure.machine())
    if rows:
        measure.write_reconstructions(folder, table, rows)
    _finish(table, folder, len(rows), len(asked), as_json=json, interrupted=interrupted)


def _scene(category: str | None, seed: int) -> renderer.Scene:
    scene = renderer.paper_scene().scene_at(0)
    if category is None:
        return scene
    return replace(scene, object_depth_m=hidden_depth(category, scene.rig, {"seed": seed or None}))


def _collect(measured: Iterator[R], rows: list[R], planned: int) -> bool:
    """Append rows as they are measured; return True if interrupted."""
    try:
        with common.interrupted_by_signals(), common.tracked("measuring") as on_progress:
            on_progress(0, planned)
            for row in measured:
                rows.append(row)
                on_progress(len(rows), planned)
    except KeyboardInterrupt:
        return True
    return False


def _finish(
    table: dict[str, object],
    folder: Path,
    done: int,
    planned: int,
    *,
    as_json: bool,
    interrupted: bool,
) -> None:
    text = "Nothing measured"
    if done:
        text = f"Measured {done} of {planned} settings: open {folder / measure.TRADEOFF_REPORT}"
    common.finish({**table, "out": str(folder) if done else None}, as_json=as_json, text=text)
    if interrupted:
        common.exit_interrupted(f"{done} of {planned} settings are measured")
