"""`predict`: what a bench can see, before it is built or anything is trained."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from nlos_cam import bench as bench_folders
from nlos_cam import forecast, objects
from nlos_cam.cli import benches
from nlos_cam.cli.common import (
    PAPER_RIG,
    Json,
    Overwrite,
    finish,
    interrupted_by_signals,
    output_path,
    say,
    show,
    tracked,
)
from nlos_cam.cli.render import hidden_depth

SUFFIXES = ".html", ".png"
TABLE_COLUMNS = 80
"""Width of a terminal that the full table fits, with the longest word of its labels on a line."""


def predict(
    rig: Annotated[
        str | None,
        typer.Argument(
            metavar="[RIG_OR_BENCH]",
            help="Name of a packaged rig, a rig's TOML file, a wall.toml, or a bench folder;"
            " default: paper-rig. With --bench, the first argument is OBJECT.",
        ),
    ] = None,
    hidden: Annotated[
        str | None,
        typer.Argument(
            metavar="[OBJECT]",
            help="A category's name, a mesh or a .npy depth map; default: typical objects.",
        ),
    ] = None,
    bench_folder: Annotated[
        Path | None,
        typer.Option(
            "--bench", help="Bench folder of `calibrate --bench`, in place of RIG_OR_BENCH."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Page (.html) or picture (.png) with the maps.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Matt objects, 1 and 100 frames, no advice: a few seconds."),
    ] = False,
    size_m: Annotated[
        float | None, typer.Option("--size-m", help="Size of OBJECT in meters.")
    ] = None,
    turn_deg: Annotated[
        float | None, typer.Option("--tilt-y-deg", help="Rotation of OBJECT about the wall's y.")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Forecast what a bench can see: silhouettes, depths, by frames and material; what to change."""
    if out is not None and out.suffix not in SUFFIXES:
        raise typer.BadParameter(f"--out {out}: choose a name that ends in .html or .png")
    path = output_path(out, "forecast", ".html", overwrite=overwrite) if out else None
    if bench_folder is not None:
        if hidden is not None:
            raise typer.BadParameter(f"--bench and {rig} each name a rig: give one")
        own = bench_folders.load_bench(bench_folder).rig
        rig, hidden = str(bench_folder), rig
    else:
        own, _ = benches.bench_or_rig(rig or PAPER_RIG)
    shape = None
    if hidden is not None:
        depth_m = hidden_depth(hidden, own, {"size_m": size_m, "tilt_y_deg": turn_deg})
        shape = forecast.Shape.of(depth_m, objects.object_box(own))
    elif size_m is not None or turn_deg is not None:
        raise typer.BadParameter("--size-m and --tilt-y-deg are of an OBJECT: name one")
    with interrupted_by_signals():
        found = forecast.forecast(own, quick=quick, shape=shape)
        advice: list[forecast.Change] = []
        if not quick and shape is None:
            with tracked("trying changes of the bench") as on_progress:
                advice = forecast.changes(own, on_progress)
    _renew_forecast(rig, found, is_typical=shape is None)
    if path is not None:
        forecast.write_report(found, path, advice, hidden or "")
    facts = found.as_json() | {
        "object": hidden,
        "changes": [
            {name: value for name, value in asdict(change).items() if name != "rig"}
            for change in advice
        ],
        "out": path and str(path),
    }
    lines = forecast.words_of(found, hidden or "")
    if advice:
        lines += ["What to change:", *(f"  {line}" for line in forecast.change_words(advice))]
    lines += [f"Written: {path}"] if path else []
    if not json:
        show(_table(found), narrow_columns=TABLE_COLUMNS)
        lines.insert(0, forecast.COLUMNS)
    finish(facts, as_json=json, text="\n".join(lines))


def _renew_forecast(name: str | None, found: forecast.Forecast, *, is_typical: bool) -> None:
    """Enter a forecast of typical objects in the record of a bench whose object box was edited
    since its own.
    """
    if name is None or not is_typical or not Path(name).is_dir():
        return
    bench = bench_folders.load_bench(name)
    if bench.has_old_forecast:
        benches.keep_forecast(bench, found)
        say(f"Renewed the forecast in {bench.folder}")


def _table(found: forecast.Forecast) -> Table:
    content = forecast.table_of(found)
    table = Table(box=None, pad_edge=False)
    table.add_column(content.head[0])
    for name in content.head[1:]:
        table.add_column(name, justify="right", no_wrap=True)
    for row in content.rows:
        table.add_row(*row)
    return table
