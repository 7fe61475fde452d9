"""`tradeoff render|reconstruct`: what accuracy costs in time, measured here and now."""

from collections.abc import Iterator
from dataclasses import replace
from json import dumps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from nlos_calibration import rig_named
from nlos_models import load_record, refuse_color, shipped_folder

from nlos_cam.cli.common import INTERRUPTED, Json, Overwrite, finish, interrupted_by_signals, output_path, say, tracked
from nlos_cam.cli.render import hidden_depth
from nlos_cam.dataset import TEST_SEED
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import (
    RenderRow,
    RuntimeBench,
    RuntimeRow,
    as_table,
    draw_renders,
    draw_runtimes,
    machine,
    measure_renders,
    measure_runtimes,
    render_facts,
    render_markdown,
    render_settings,
    runtime_facts,
    runtime_markdown,
    runtime_settings,
    runtimes,
    seeded_objects,
)
from nlos_cam.files import atomic_directory, cache_folder
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.render import Scene, paper_scene

R = TypeVar("R")


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    tradeoff = typer.Typer(help="What accuracy costs in time.")
    tradeoff.command("render")(render)
    tradeoff.command("reconstruct")(reconstruct)
    app.add_typer(tradeoff, name="tradeoff")


def render(
    out: Annotated[Path | None, typer.Option("--out", help="A folder for table and plot.")] = None,
    category: Annotated[
        str | None,
        typer.Option("--object", help="A category, mesh or depth map to hide; else the default scene's airplane."),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Which variation of the category.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Measure every stop of the renderer's dial, and what each is made of, against brute force (some 30 s)."""
    if seed is not None and category is None:
        raise typer.BadParameter("--seed varies an --object: give both")
    folder = output_path(out, "tradeoff", "", overwrite=overwrite)
    scene = _scene(category, seed or 0)
    size, planned = render_facts(scene), len(render_settings(scene))
    rows, interrupted = _measured(scene, planned)
    table = as_table(size, rows, planned)
    if rows:
        _write(folder, table, rows, category or "airplane")
    text = f"{len(rows)} of {planned} settings measured: {folder}" if rows else "nothing was measured"
    finish({**table, "out": str(folder) if rows else None}, as_json=json, text=text)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def reconstruct(
    out: Annotated[Path | None, typer.Option("--out", help="A folder for table and plot.")] = None,
    weights: Annotated[
        list[Path] | None,
        typer.Option("--weights", help="Other weights than the shipped ones; more than once to compare."),
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Measure on so many random objects, not on the 54.")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Measure number formats, runtimes, threads and averaged frames on the 54 test objects (a minute or two)."""
    folder = output_path(out, "tradeoff", "", overwrite=overwrite)
    folders: dict[str, Path | None] = {str(path): path for path in weights} if weights else {"shipped": None}
    rows: list[RuntimeRow] = []
    with interrupted_by_signals():
        say("rendering, exporting and quantising first")
        bench = _bench(folders, count)
        makes = {name: runtimes(path, bench.rig, bench.box, cache_folder() / "onnx") for name, path in folders.items()}
    asked = runtime_settings([*makes], [*next(iter(makes.values()))])
    interrupted = _collect(measure_runtimes(asked, makes, bench), rows, len(asked))
    table = runtime_facts(rows, len(asked), len(bench.truth), machine())
    if rows:
        with atomic_directory(folder) as part:
            _write_files(part, table, runtime_markdown(table))
            draw_runtimes(part / "tradeoff.png", rows)
    text = f"{len(rows)} of {len(asked)} settings measured: {folder}" if rows else "nothing was measured"
    finish({**table, "out": str(folder) if rows else None}, as_json=json, text=text)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _bench(folders: dict[str, Path | None], count: int | None) -> RuntimeBench:
    """The objects on the rig of all these weights.

    Raises SceneError where they are for different rigs, CheckpointError where some are of full colour.
    """
    records = {name: load_record(path or shipped_folder()) for name, path in folders.items()}
    for name, record in records.items():
        refuse_color(record, folders[name])
    rigs = {record.rig_name for record in records.values()}
    if len(rigs) > 1:
        raise SceneError(f"these weights are for different rigs ({', '.join(sorted(rigs))}): compare those of one rig")
    if eaten := {record.input for record in records.values()} - {"raw maps"}:
        raise SceneError(f"these weights eat {eaten.pop()}, and test maps are raw maps: use other weights")
    rig = rig_named(rigs.pop())
    box = object_box(rig)
    subjects = seeded_objects(TEST_SEED, count, box) if count else benchmark_objects(box)
    with tracked("rendering") as on_progress:
        return RuntimeBench.of(subjects, rig, box, on_progress)


def _scene(category: str | None, seed: int) -> Scene:
    scene = paper_scene().scene_at(0)
    if category is None:
        return scene
    return replace(scene, object_depth_m=hidden_depth(category, scene.rig, {"seed": seed or None}))


def _measured(scene: Scene, planned: int) -> tuple[list[RenderRow], bool]:
    """The rows, as far as they were measured, and whether somebody cut it short."""
    rows: list[RenderRow] = []
    say("brute force first: that takes longest")
    return rows, _collect(measure_renders(scene), rows, planned)


def _collect(measured: Iterator[R], rows: list[R], planned: int) -> bool:
    """Add rows to `rows` as they are measured; whether somebody cut it short."""
    try:
        with interrupted_by_signals(), tracked("measuring") as on_progress:
            on_progress(0, planned)
            for row in measured:
                rows.append(row)
                on_progress(len(rows), planned)
    except KeyboardInterrupt:
        return True
    return False


def _write_files(folder: Path, table: dict[str, Any], text: str) -> None:
    (folder / "tradeoff.json").write_text(dumps(table, indent=2) + "\n", encoding="utf-8")
    (folder / "tradeoff.md").write_text(text, encoding="utf-8")


def _write(folder: Path, table: dict[str, Any], rows: list[RenderRow], name: str) -> None:
    title = f"{name}: {table['patches']} patches, {table['beams_on_wall']} beams on the wall"
    with atomic_directory(folder) as part:
        _write_files(part, table, render_markdown(table))
        draw_renders(part / "tradeoff.png", rows, title)
