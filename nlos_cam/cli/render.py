"""`render`: one hidden object to the maps that the lidar would report, with numbers and a picture."""

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from nlos_calibration.wall_record import rig_named
from rich.table import Table

from nlos_cam.cli.common import Json, Overwrite, finish, output_path, stderr
from nlos_cam.cli.hidden_object import (
    Front,
    Object,
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
from nlos_cam.frames import Float32
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import load_scene


def register(app: typer.Typer) -> None:
    """Add this command to the command line."""
    app.command("render")(command)


def command(
    hidden: Object,
    out: Annotated[Path | None, typer.Option("--out", help="Maps (.npz); a picture goes beside them.")] = None,
    scene: Annotated[Path | None, typer.Option("--scene", help="A scene.toml whose rig to use.")] = None,
    rig: Annotated[str, typer.Option("--rig", help="A packaged rig's name, or a rig's TOML file.")] = "paper-rig",
    accuracy: Annotated[str, typer.Option("--accuracy", help="draft, standard, fine or reference.")] = "standard",
    seed: Seed = None,
    up: UpAxis = None,
    size_m: Size = None,
    tilt_x_deg: TiltX = None,
    tilt_y_deg: TiltY = None,
    turn_deg: Turn = None,
    x_m: OffsetX = None,
    y_m: OffsetY = None,
    front_m: Front = None,
    explain: Annotated[bool, typer.Option("--explain", help="Tell which effects the scene calls for.")] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Render what a lidar of highest-echo kind reports of a hidden object."""
    path = output_path(out and out.with_suffix(".npz"), "render", ".npz", overwrite=overwrite)
    chosen_rig = load_scene(scene).rig if scene else rig_named(rig)
    angles = {"tilt_x_deg": tilt_x_deg, "tilt_y_deg": tilt_y_deg, "turn_deg": turn_deg}
    place = {"size_m": size_m, "x_m": x_m, "y_m": y_m, "front_m": front_m}
    depth_m = hidden_depth(hidden, chosen_rig, {"seed": seed, "up": up, **angles, **place})
    target = Scene(chosen_rig, depth_m)
    started = time.perf_counter()
    rendering = render(target, accuracy)
    seconds = time.perf_counter() - started
    np.savez_compressed(
        path,
        depth_m=rendering.depth_m,
        intensity=rendering.intensity,
        margin=rendering.margin,
        object_depth_m=depth_m,
        rig_name=chosen_rig.name,
        rig_checksum=chosen_rig.checksum,
    )
    _draw(path.with_suffix(".png"), depth_m, rendering)
    if explain:
        stderr.print(_table(rendering))
    result = {"seconds": seconds, "accuracy": accuracy, "effects": _effects(rendering), "out": str(path)}
    text = f"rendered in {seconds:.2f} s at {accuracy!r}: {path}, picture {path.with_suffix('.png')}"
    finish(result, as_json=json, text=text)


def _effects(rendering: Rendering) -> list[dict[str, Any]]:
    return [
        {
            "name": effect.name,
            "included": effect.included,
            "reason": effect.reason,
            "bound": effect.bound,
            "seconds": rendering.seconds.get(effect.name, 0.0),
        }
        for effect in rendering.plan
    ]


def _table(rendering: Rendering) -> Table:
    table = Table("effect", "included", "because", "bound", "seconds")
    for effect in _effects(rendering):
        figures = f"{effect['bound']:.2g}", f"{effect['seconds']:.3f}"
        table.add_row(effect["name"], "yes" if effect["included"] else "no", effect["reason"], *figures)
    return table


def _draw(path: Path, depth_m: Float32, rendering: Rendering) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3), layout="constrained")
    titles = "hidden depth (m)", "lidar depth (m)", "lidar intensity", "margin of the winner"
    maps = depth_m, rendering.depth_m, rendering.intensity, rendering.margin
    for axis, title, image in zip(figure.subplots(1, 4), titles, maps, strict=True):
        figure.colorbar(axis.imshow(image, cmap="magma"), ax=axis)
        axis.set_title(title)
        axis.axis("off")
    figure.savefig(path, dpi=100)
