"""`predict`: what a bench can see, before it is built or anything is trained."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import nlos_calibration as walls
import typer
from nlos_calibration.errors import UnknownRigError
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
from nlos_cam.cli.config import names_object
from nlos_cam.cli.render import (
    Front,
    OffsetX,
    OffsetY,
    Seed,
    Size,
    TiltX,
    TiltY,
    Turn,
    UpAxis,
    hidden_depth,
)
from nlos_cam.errors import did_you_mean

if TYPE_CHECKING:
    from nlos_calibration.arrays import Float32

SUFFIXES = ".html", ".png"
TABLE_COLUMNS = 80
"""Width of a terminal that the full table fits, with the longest word of its labels on a line."""


def predict(
    rig: Annotated[
        str | None,
        typer.Argument(
            metavar="[RIG_OR_BENCH]",
            help="Name of a packaged rig, a rig's TOML file, a wall.toml, or a bench folder;"
            " default: the bench of --bench or of the settings, else paper-rig. It may be left out"
            " before OBJECT.",
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
    seed: Seed = None,
    up: UpAxis = None,
    size_m: Size = None,
    tilt_x_deg: TiltX = None,
    tilt_y_deg: TiltY = None,
    turn_deg: Turn = None,
    x_m: OffsetX = None,
    y_m: OffsetY = None,
    front_m: Front = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Forecast what a bench can see: silhouettes, depths, by frames and material; what to change.

    Of an OBJECT also what the lidar would show.
    """
    placement = {
        "seed": seed,
        "up": up,
        "size_m": size_m,
        "tilt_x_deg": tilt_x_deg,
        "tilt_y_deg": tilt_y_deg,
        "turn_deg": turn_deg,
        "x_m": x_m,
        "y_m": y_m,
        "front_m": front_m,
    }
    if out is not None and out.suffix not in SUFFIXES:
        raise typer.BadParameter(f"--out {out}: choose a name that ends in .html or .png")
    path = output_path(out, "forecast", ".html", overwrite=overwrite) if out else None
    if bench_folder is not None:
        if hidden is not None:
            raise typer.BadParameter(f"--bench and {rig} each name a rig: give one")
        bench_folders.load_bench_record(bench_folder)  # refuses what is no bench folder
        rig, hidden = str(bench_folder), rig
    elif hidden is None and rig is not None and names_object(rig):
        rig, hidden = None, rig
    own = _rig_of(rig or PAPER_RIG, is_alone=hidden is None)
    depth_m = _object_depth(hidden, own, placement)
    shape = None if depth_m is None else forecast.Shape.of(depth_m, objects.object_box(own))
    with interrupted_by_signals():
        found = forecast.forecast(own, quick=quick, shape=shape)
        view = None if depth_m is None else forecast.LidarView.of(own, depth_m)
        advice: list[forecast.Change] = []
        if not quick and shape is None:
            with tracked("trying changes of the bench") as on_progress:
                advice = forecast.changes(own, on_progress)
    if path is not None:
        forecast.write_report(found, path, advice, hidden or "", view)
    facts = found.as_json() | {
        "object": hidden,
        "lidar": view and view.as_json(),
        "changes": [
            {name: value for name, value in asdict(change).items() if name != "rig"}
            for change in advice
        ],
        "out": path and str(path),
    }
    lines = forecast.words_of(found, hidden or "")
    lines += [view.words()] if view else []
    if advice:
        lines += ["What to change:", *(f"  {line}" for line in forecast.change_words(advice))]
    lines += [f"Written: {path}"] if path else []
    if not json:
        show(_table(found), narrow_columns=TABLE_COLUMNS)
        lines.insert(0, forecast.COLUMNS)
    finish(facts, as_json=json, text="\n".join(lines))
    if shape is None and rig is not None and benches.names_folder(rig):  # last: it can be refused
        _renew_forecast(Path(rig), found)


def _rig_of(name: str, *, is_alone: bool) -> walls.Rig:
    """Return the rig of a name or path. Raises UnknownRigError, with the nearest object for a name
    that is given alone, since it may be meant as one.
    """
    try:
        return benches.bench_or_rig(name)[0]
    except UnknownRigError as error:
        if not is_alone:
            raise
        near = did_you_mean(name, objects.CATEGORIES)
        raise UnknownRigError(f"{error}, or an object's name.{near}") from error


def _object_depth(hidden: str | None, rig: walls.Rig, placement: dict[str, Any]) -> Float32 | None:
    """Return the depth map of OBJECT, None without one. Raises typer.BadParameter for a placement of
    none.
    """
    if hidden is not None:
        return hidden_depth(hidden, rig, placement)
    given = [
        f"--{name.replace('_', '-')}" for name, value in placement.items() if value is not None
    ]
    if given:
        raise typer.BadParameter(f"{', '.join(given)}: no OBJECT is named that it could place")
    return None


def _renew_forecast(folder: Path, found: forecast.Forecast) -> None:
    """Enter a forecast of typical objects in the record of a bench that has none of its rig."""
    bench = bench_folders.load_bench(folder, weights=False)
    if bench.can_be_forecast and bench.forecast is None:
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
