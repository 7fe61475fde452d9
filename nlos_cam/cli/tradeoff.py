"""The commands `tradeoff render` and `tradeoff reconstruct`: accuracy against time, measured on this machine."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from nlos_cam.cli.common import INTERRUPTED, Json, Overwrite, finish, interrupted_by_signals, output_path, say, tracked
from nlos_cam.cli.render import hidden_depth
from nlos_cam.evaluate import (
    RenderRow,
    RuntimeRow,
    as_table,
    machine,
    measure_renders,
    measure_runtimes,
    open_runtime_bench,
    render_facts,
    render_settings,
    runtime_facts,
    runtime_settings,
    runtimes,
    write_renders,
    write_runtimes,
)
from nlos_cam.files import cache_folder
from nlos_cam.render import Scene, paper_scene

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
        str | None, typer.Option("--object", help="Category, mesh or depth map to hide (default: an airplane).")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Variation of the category.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Measure the renderer's accuracy stops and their ingredients against brute force (about 30 s)."""
    if seed is not None and category is None:
        raise typer.BadParameter("--seed is the variation of an --object: give both")
    folder = output_path(out, "tradeoff", "", overwrite=overwrite)
    scene = _scene(category, seed or 0)
    size, planned = render_facts(scene), len(render_settings(scene))
    rows: list[RenderRow] = []
    say("Rendering the reference first (slowest step, about 30 s)")
    interrupted = _collect(measure_renders(scene), rows, planned)
    table = as_table(size, rows, planned)
    if rows:
        write_renders(folder, table, rows, category or "airplane")
    _finish(table, folder, len(rows), planned, as_json=json, interrupted=interrupted)


def reconstruct(
    out: Out = None,
    weights: Annotated[
        list[Path] | None, typer.Option("--weights", help="Folder of weights (default: shipped); repeat to compare.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Number of random objects, instead of the 54 test objects.")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Measure number formats, runtimes, threads and averaged frames on the test objects (1 to 2 minutes)."""
    folder = output_path(out, "tradeoff", "", overwrite=overwrite)
    folders: dict[str, Path | None] = {str(path): path for path in weights} if weights else {"shipped": None}
    rows: list[RuntimeRow] = []
    with interrupted_by_signals():
        say("Rendering test objects, exporting and quantising networks first")
        bench = open_runtime_bench(folders, count, tracked)
        makes = {name: runtimes(path, bench.rig, bench.box, cache_folder() / "onnx") for name, path in folders.items()}
    asked = runtime_settings([*makes], [*next(iter(makes.values()))])
    interrupted = _collect(measure_runtimes(asked, makes, bench), rows, len(asked))
    table = runtime_facts(rows, len(asked), len(bench.truth), machine())
    if rows:
        write_runtimes(folder, table, rows)
    _finish(table, folder, len(rows), len(asked), as_json=json, interrupted=interrupted)


def _scene(category: str | None, seed: int) -> Scene:
    scene = paper_scene().scene_at(0)
    if category is None:
        return scene
    return replace(scene, object_depth_m=hidden_depth(category, scene.rig, {"seed": seed or None}))


def _collect(measured: Iterator[R], rows: list[R], planned: int) -> bool:
    """Append rows as they are measured; return True if interrupted."""
    try:
        with interrupted_by_signals(), tracked("measuring") as on_progress:
            on_progress(0, planned)
            for row in measured:
                rows.append(row)
                on_progress(len(rows), planned)
    except KeyboardInterrupt:
        return True
    return False


def _finish(
    table: dict[str, object], folder: Path, done: int, planned: int, *, as_json: bool, interrupted: bool
) -> None:
    text = f"Measured {done} of {planned} settings: {folder}" if done else "Interrupted; nothing measured."
    finish({**table, "out": str(folder) if done else None}, as_json=as_json, text=text)
    if interrupted:
        raise typer.Exit(INTERRUPTED)
