"""`tradeoff render|reconstruct`: what accuracy costs in time, measured here and now."""

from collections.abc import Iterator
from dataclasses import replace
from json import dumps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import load_record, shipped_folder
from nlos_models.inference import refuse_colour

from nlos_cam.cli.common import INTERRUPTED, Json, Overwrite, finish, interrupted_by_signals, output_path, say, tracked
from nlos_cam.cli.render import hidden_depth
from nlos_cam.dataset.build import TEST_SEED
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import runtime_tradeoff as reconstruction
from nlos_cam.evaluate import runtime_tradeoff as reconstruction_report
from nlos_cam.evaluate.render_tradeoff import Row, as_markdown, as_table, draw, facts, machine, measure, settings
from nlos_cam.evaluate.subjects import seeded_objects
from nlos_cam.files import atomic_directory, cache_folder
from nlos_cam.objects.benchmark import benchmark_objects
from nlos_cam.objects.depth_map import object_box
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import paper_scene

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
    size, planned = facts(scene), len(settings(scene))
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
    rows: list[reconstruction.Row] = []
    with interrupted_by_signals():
        say("rendering, exporting and quantising first")
        bench = _bench(folders, count)
        makes = {
            name: reconstruction.runtimes(path, bench.rig, bench.box, cache_folder() / "onnx")
            for name, path in folders.items()
        }
    asked = reconstruction.settings([*makes], [*next(iter(makes.values()))])
    interrupted = _collect(reconstruction.measure(asked, makes, bench), rows, len(asked))
    table = reconstruction_report.facts(rows, len(asked), len(bench.truth), machine())
    if rows:
        with atomic_directory(folder) as part:
            _write_files(part, table, reconstruction_report.as_markdown(table))
            reconstruction_report.draw(part / "tradeoff.png", rows)
    text = f"{len(rows)} of {len(asked)} settings measured: {folder}" if rows else "nothing was measured"
    finish({**table, "out": str(folder) if rows else None}, as_json=json, text=text)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _bench(folders: dict[str, Path | None], count: int | None) -> reconstruction.Bench:
    """The objects on the rig of all these weights.

    Raises SceneError where they are for different rigs, CheckpointError where some are of full colour.
    """
    records = {name: load_record(path or shipped_folder()) for name, path in folders.items()}
    for name, record in records.items():
        refuse_colour(record, folders[name])
    rigs = {record.rig_name for record in records.values()}
    if len(rigs) > 1:
        raise SceneError(f"these weights are for different rigs ({', '.join(sorted(rigs))}): compare those of one rig")
    if eaten := {record.input for record in records.values()} - {"raw maps"}:
        raise SceneError(f"these weights eat {eaten.pop()}, and test maps are raw maps: use other weights")
    rig = rig_named(rigs.pop())
    box = object_box(rig)
    subjects = seeded_objects(TEST_SEED, count, box) if count else benchmark_objects(box)
    with tracked("rendering") as on_progress:
        return reconstruction.Bench.of(subjects, rig, box, on_progress)


def _scene(category: str | None, seed: int) -> Scene:
    scene = paper_scene().scene_at(0)
    if category is None:
        return scene
    return replace(scene, object_depth_m=hidden_depth(category, scene.rig, {"seed": seed or None}))


def _measured(scene: Scene, planned: int) -> tuple[list[Row], bool]:
    """The rows, as far as they were measured, and whether somebody cut it short."""
    rows: list[Row] = []
    say("brute force first: that takes longest")
    return rows, _collect(measure(scene), rows, planned)


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


def _write(folder: Path, table: dict[str, Any], rows: list[Row], name: str) -> None:
    title = f"{name}: {table['patches']} patches, {table['beams_on_wall']} beams on the wall"
    with atomic_directory(folder) as part:
        _write_files(part, table, as_markdown(table))
        draw(part / "tradeoff.png", rows, title)
