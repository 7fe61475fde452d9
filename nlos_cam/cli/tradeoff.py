"""`tradeoff render`: what accuracy costs in time, measured here and now against brute force."""

from dataclasses import replace
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import typer

from nlos_cam.cli.common import INTERRUPTED, Json, Overwrite, finish, interrupted_by_signals, output_path, say, tracked
from nlos_cam.cli.hidden_object import hidden_depth
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import paper_scene
from nlos_cam.render.tradeoff import Row, facts, measure, settings
from nlos_cam.render.tradeoff_report import as_markdown, as_table, draw


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    tradeoff = typer.Typer(help="What accuracy costs in time.")
    tradeoff.callback()(_group)
    tradeoff.command("render")(render)
    app.add_typer(tradeoff, name="tradeoff")


def _group() -> None:
    """Make of a single command a group all the same."""


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


def _scene(category: str | None, seed: int) -> Scene:
    scene = paper_scene().scene_at(0)
    if category is None:
        return scene
    return replace(scene, object_depth_m=hidden_depth(category, scene.rig, {"seed": seed or None}))


def _measured(scene: Scene, planned: int) -> tuple[list[Row], bool]:
    """The rows, as far as they were measured, and whether somebody cut it short."""
    rows: list[Row] = []
    say("brute force first: that takes longest")
    try:
        with interrupted_by_signals(), tracked("measuring") as on_progress:
            on_progress(0, planned)
            for row in measure(scene):
                rows.append(row)
                on_progress(len(rows), planned)
    except KeyboardInterrupt:
        return rows, True
    return rows, False


def _write(folder: Path, table: dict[str, Any], rows: list[Row], name: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "tradeoff.json").write_text(dumps(table, indent=2) + "\n", encoding="utf-8")
    (folder / "tradeoff.md").write_text(as_markdown(table), encoding="utf-8")
    draw(
        folder / "tradeoff.png", rows, f"{name}: {table['patches']} patches, {table['beams_on_wall']} beams on the wall"
    )
