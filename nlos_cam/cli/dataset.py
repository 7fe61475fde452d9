"""`dataset build`: objects and renderer to training maps."""

import os
from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.wall_record import rig_named

from nlos_cam import dataset
from nlos_cam.cli.common import PAPER_RIG, Json, finish, tracked


def register(app: typer.Typer) -> None:
    """Add the command."""
    data = typer.Typer(help="Training data.")
    data.callback()(lambda: None)  # else typer leaves out the name of an only command
    data.command("build")(build)
    app.add_typer(data, name="dataset")


def build(
    out: Annotated[Path, typer.Option("--out", help="The dataset's folder; shards that are there are kept.")],
    count: Annotated[int, typer.Option("--count", min=1, help="Objects in all.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first object; the others follow.")] = 0,
    rig: Annotated[str, typer.Option("--rig", help="A packaged rig's name, or a rig's TOML file.")] = PAPER_RIG,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes.")] = os.cpu_count() or 1,
    json: Json = False,
) -> None:
    """Render random objects into HDF5 shards; run it again after a stop and it goes on."""
    plan = dataset.DatasetPlan(rig_named(rig), seed)
    with tracked("rendering objects") as on_progress:
        dataset.build(plan, count, out, workers=workers, on_progress=on_progress)
    finish({"objects": count, "out": str(out)}, as_json=json, text=f"{count} objects in {out}")
