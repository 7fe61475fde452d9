"""`nlos-cam scenes|objects|rigs|recipes`: things that come with the package, by name."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees
from pathlib import Path
from typing import Annotated

import nlos_calibration as walls
import typer
from nlos_models import training

from nlos_cam import camera as cameras
from nlos_cam import objects as shapes
from nlos_cam import render as renderer
from nlos_cam.cli.common import PAPER_RIG, Json, finish

RigName = Annotated[
    str | None,
    typer.Argument(metavar="NAME", help="Packaged rig, rig's TOML file, or wall record."),
]
HEAD = "# A whole rig: change what differs, and name the file as --rig or in a scene"


def scenes(json: Json = False) -> None:
    """List the packaged scenes: simulated benches, used as CAMERA."""
    examples = {f"sim:{name}": _title(path) for name, path in renderer.packaged_scenes().items()}
    _print("scenes", {**cameras.SIMULATED, **examples}, as_json=json)


def objects(
    test: Annotated[
        bool,
        typer.Option("--test", help="List the 54 test objects of `evaluate` instead."),
    ] = False,
    json: Json = False,
) -> None:
    """List the kinds of hidden objects, for `render` and scene files."""
    if test:
        box = shapes.object_box(walls.load_rig(PAPER_RIG))
        found = {each.name: _placed(each) for each in shapes.benchmark_objects(box)}
        _print("objects", found, as_json=json)
        return
    kinds = shapes.CATEGORIES.items()
    varies = {name: f"varies in {', '.join(kind.settings)}" for name, kind in kinds}
    _print("objects", varies, as_json=json)


def rigs(name: RigName = None, json: Json = False) -> None:
    """List the packaged rigs, for --rig and scene files; with NAME, print the rig whole, as TOML.

    A file with base = "paper-rig" needs only the keys that it changes.
    """
    if name is not None:
        rig = walls.rig_named(name)
        text = f"{HEAD}\n{walls.dump_toml(rig)}".rstrip()
        finish({"rig": rig.model_dump(mode="json")}, as_json=json, text=text)
        return
    _print("rigs", {path.stem: _title(path) for path in walls.packaged_rigs()}, as_json=json)


def recipes(json: Json = False) -> None:
    """List the packaged training recipes, for --recipe."""
    titles = {name: _title(path) for name, path in training.packaged_recipes().items()}
    _print("recipes", titles, as_json=json)


def _placed(subject: shapes.BenchmarkObject) -> str:
    """Return the settings of a test object, and how it stands in the box."""
    settings = ", ".join(f"{name} {value:.2f}" for name, value in subject.settings.items())
    pose = subject.pose
    turns = (pose.tilt_x_rad, pose.tilt_y_rad, pose.turn_z_rad)
    angles = ", ".join(f"{degrees(turn):.0f}" for turn in turns)
    return (
        f"{settings}; {100 * pose.size_m:.0f} cm, front {1e3 * pose.front_m:.0f} mm behind the"
        f" box's, turned {angles} degrees about x, y, z"
    )


def _title(path: Path) -> str:
    """Return the comment at the head of a TOML file, less the command in it."""
    line = path.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
    return line.partition(": `")[0].rstrip(".:")


def _print(kind: str, found: Mapping[str, str], *, as_json: bool) -> None:
    width = max(map(len, found))
    text = "\n".join(f"{name:{width}}  {description}" for name, description in found.items())
    rows = [{"name": name, "description": description} for name, description in found.items()]
    finish({kind: rows}, as_json=as_json, text=text)
