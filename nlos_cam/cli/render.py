"""`render`: one hidden object to the maps that the lidar would report, with numbers and a picture."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from nlos_calibration.arrays import Float32
from nlos_calibration.wall_record import rig_named
from rich.table import Table

from nlos_cam.cli import how
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
from nlos_cam.render.accuracy_search import costs
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import load_scene
from nlos_cam.render.sensor.effects import sensor_effects
from nlos_cam.render.sensor.model import SensorModel


def register(app: typer.Typer) -> None:
    """Add this command to the command line."""
    app.command("render")(command)


def command(
    hidden: Object,
    out: Annotated[Path | None, typer.Option("--out", help="Maps (.npz); a picture goes beside them.")] = None,
    scene: Annotated[Path | None, typer.Option("--scene", help="A scene.toml: its object gives way to OBJECT.")] = None,
    rig: Annotated[str, typer.Option("--rig", help="A packaged rig's name, or a rig's TOML file.")] = "paper-rig",
    accuracy: how.Stop = None,
    max_error: how.MaxError = None,
    max_seconds: how.MaxSeconds = None,
    seed: Seed = None,
    up: UpAxis = None,
    size_m: Size = None,
    tilt_x_deg: TiltX = None,
    tilt_y_deg: TiltY = None,
    turn_deg: Turn = None,
    x_m: OffsetX = None,
    y_m: OffsetY = None,
    front_m: Front = None,
    radiometry: how.RadiometryName = None,
    material: how.MaterialKind = None,
    specular: how.Specular = None,
    exponent: how.Exponent = None,
    albedo: how.Albedo = None,
    pulse_ns: how.PulseNs = None,
    beams_per_cell: how.BeamsPerCell = None,
    effects: how.EffectNames = "auto",
    backend: how.Backend = "cpu",
    explain: Annotated[bool, typer.Option("--explain", help="Tell which effects the scene calls for.")] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Render what a lidar of highest-echo kind reports of a hidden object."""
    path = output_path(out and out.with_suffix(".npz"), "render", ".npz", overwrite=overwrite)
    file = load_scene(scene) if scene else None
    bare = file.bare if file else Scene(rig_named(rig))
    surface = {"kind": material, "specular": specular, "exponent": exponent, "albedo": albedo}
    bare = how.scene_of(bare, surface, {"radiometry": radiometry, "pulse_ns": pulse_ns})
    angles = {"tilt_x_deg": tilt_x_deg, "tilt_y_deg": tilt_y_deg, "turn_deg": turn_deg}
    place = {"size_m": size_m, "x_m": x_m, "y_m": y_m, "front_m": front_m}
    depth_m = hidden_depth(hidden, bare.rig, {"seed": seed, "up": up, **angles, **place})
    target, wanted = replace(bare, object_depth_m=depth_m), how.effects_of(effects)
    setting = how.accuracy_of(accuracy, max_error, max_seconds, beams_per_cell, target, wanted, backend)
    started = time.perf_counter()
    rendering = render(target, setting, wanted, backend)
    seconds = time.perf_counter() - started
    _save(path, target, depth_m, rendering)
    _draw(path.with_suffix(".png"), depth_m, rendering)
    sensor, measured = file.sensor if file else SensorModel(), explain and setting.sub_bins > 0
    told = _effects(target, rendering, sensor, backend, measured=measured)
    if explain:
        stderr.print(_table(told))
    facts = {"seconds": seconds, "accuracy": setting.name, "near_legs": rendering.near_legs}
    text = f"rendered in {seconds:.2f} s at {setting.name!r}: {path}, picture {path.with_suffix('.png')}"
    finish({**facts, "effects": told, "out": str(path)}, as_json=json, text=text)


def _save(path: Path, scene: Scene, depth_m: Float32, rendering: Rendering) -> None:
    arrays = {
        "depth_m": rendering.depth_m,
        "intensity": rendering.intensity,
        "margin": rendering.margin,
        "object_depth_m": depth_m,
        "rig_name": np.array(scene.rig.name),
        "rig_checksum": np.array(scene.rig.checksum),
        "radiometry": np.array(scene.radiometry),
    }
    if rendering.colour is not None:
        arrays["colour"] = rendering.colour
    np.savez_compressed(path, allow_pickle=False, **arrays)


def _effects(
    scene: Scene, rendering: Rendering, sensor: SensorModel, backend: str, *, measured: bool
) -> list[dict[str, Any]]:
    """The verdicts as facts; what each costs in seconds where that is to be measured, the sensor's own aside."""
    seconds = costs(scene, rendering.accuracy, rendering.plan, backend) if measured else {}
    return [
        {
            "name": effect.name,
            "included": effect.included,
            "reason": effect.reason,
            "bound": effect.bound,
            "seconds": seconds.get(effect.name),
        }
        for effect in (*rendering.plan, *sensor_effects(sensor))
    ]


def _table(effects: list[dict[str, Any]]) -> Table:
    table = Table("effect", "included", "because", "bound", "adds")
    for effect in effects:
        cost = "" if effect["seconds"] is None else f"{1000 * effect['seconds']:.1f} ms"
        figures = f"{effect['bound']:.2g}", cost
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
