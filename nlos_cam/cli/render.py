"""`render`: one hidden object to the maps that the lidar would report, with numbers and a picture."""

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from nlos_calibration.wall_record import rig_named
from rich.table import Table

from nlos_cam.cli.common import Json, Overwrite, finish, output_path, stderr
from nlos_cam.errors import SceneError
from nlos_cam.objects.categories import CATEGORIES
from nlos_cam.objects.hidden import Pose, category_triangles, place
from nlos_cam.objects.raster import orthographic_depth
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import load_scene


def register(app: typer.Typer) -> None:
    """Add this command to the command line."""
    app.command("render")(command)


def command(
    hidden: Annotated[str, typer.Argument(metavar="OBJECT", help="A category's name, or a .npy depth map (64, 64).")],
    out: Annotated[Path | None, typer.Option("--out", help="Maps (.npz); a picture goes beside them.")] = None,
    scene: Annotated[Path | None, typer.Option("--scene", help="A scene.toml whose rig to use.")] = None,
    rig: Annotated[str, typer.Option("--rig", help="A packaged rig's name, or a rig's TOML file.")] = "paper-rig",
    accuracy: Annotated[str, typer.Option("--accuracy", help="draft, standard, fine or reference.")] = "standard",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Which variation of the category.")] = 0,
    explain: Annotated[bool, typer.Option("--explain", help="Tell which effects the scene calls for.")] = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Render what a lidar of highest-echo kind reports of a hidden object."""
    path = output_path(out and out.with_suffix(".npz"), "render", ".npz", overwrite=overwrite)
    chosen_rig = load_scene(scene).rig if scene else rig_named(rig)
    target = Scene(chosen_rig)
    depth_m = _depth_of(hidden, seed, target)
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


def _depth_of(hidden: str, seed: int, scene: Scene) -> np.ndarray[Any, np.dtype[np.float32]]:
    if hidden.endswith(".npy"):
        try:
            return np.load(hidden).astype(np.float32)
        except (OSError, ValueError, EOFError) as error:
            raise SceneError(f"{hidden} cannot be read as a depth map: {error}") from error
    if hidden not in CATEGORIES:
        raise SceneError(f"no object {hidden!r}: give a .npy depth map, or one of {', '.join(CATEGORIES)}")
    return orthographic_depth(place(category_triangles(hidden, seed), Pose(), scene.box), scene.box)


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


def _draw(path: Path, depth_m: np.ndarray[Any, np.dtype[np.float32]], rendering: Rendering) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3), layout="constrained")
    titles = "hidden depth (m)", "lidar depth (m)", "lidar intensity", "margin of the winner"
    maps = depth_m, rendering.depth_m, rendering.intensity, rendering.margin
    for axis, title, image in zip(figure.subplots(1, 4), titles, maps, strict=True):
        figure.colorbar(axis.imshow(image, cmap="magma"), ax=axis)
        axis.set_title(title)
        axis.axis("off")
    figure.savefig(path, dpi=100)
