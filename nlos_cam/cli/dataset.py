"""`dataset build|label`: objects and renderer, or labelled recordings, to training maps.

The command that made a dataset, as its shards tell it.

`dataset label`: labelled recordings to training maps.
"""

import os
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer
from nlos_calibration import rig_named
from nlos_models import SIMULATION_ONLY
from rich.progress import ProgressColumn, Task
from rich.text import Text

from nlos_cam.cli.common import PAPER_RIG, Json, Overwrite, finish, output_path, progress, say, tracked
from nlos_cam.dataset import (
    FRAMES_EACH,
    Built,
    DatasetPlan,
    Objects,
    RigSpread,
    build_dataset,
    objects_of,
    read_labelled,
    recordings_in,
    write_shards,
)
from nlos_cam.objects import TEXTURES
from nlos_cam.render import accuracy_named, load_scene


def command_of(context: typer.Context, name: str) -> str:
    """The command as it could be given again: its arguments, and every option but --json with its value."""
    words = ["nlos-cam", "dataset", name]
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if value is None or value is False or parameter.name == "json":
            continue
        option = [] if parameter.param_type_name == "argument" else [parameter.opts[0]]
        words += option if value is True else [*option, str(value)]
    return shlex.join(words)


Recordings = Annotated[Path, typer.Argument(metavar="DIR", help="A folder of recordings, each with its label.")]
Wall = Annotated[
    Path | None,
    typer.Option("--wall", help="The bench's wall record, the one that `live` is given: corrects the maps."),
]
Each = Annotated[int, typer.Option("--frames", min=1, help="Of each recording, evenly spread over it.")]


def add_label(data: typer.Typer) -> None:
    """Add the command to the group `dataset`."""
    data.command("label")(label)


def label(
    context: typer.Context,
    recordings: Recordings,
    out: Annotated[Path, typer.Option("--out", help="The dataset's folder.")],
    wall: Wall = None,
    frames: Each = FRAMES_EACH,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Make a dataset of labelled recordings of known objects: maps of single frames, and what was hidden meanwhile.

    A label is the name of a test object, or of files beside the recordings: LABEL.truth.toml (with the
    fields of a scene file's object; of the mesh LABEL.stl, .obj or .ply, unless it names another), or LABEL.npy (a
    depth map).
    """
    folder = output_path(out, "dataset", "", overwrite=overwrite)
    found = recordings_in(recordings)
    with tracked("reading recordings") as on_progress:
        labelled = read_labelled(found, wall=wall, frames=frames, on_progress=on_progress)
    write_shards(labelled, folder, command_of(context, "label"))
    labels = sorted(set(labelled.label))
    rig = {"rig_name": labelled.rig.name, "rig_checksum": labelled.rig.checksum}
    result = {"out": str(folder), "samples": len(labelled.label), "recordings": len(found), "labels": labels, **rig}
    text = f"{len(labelled.label)} samples of {len(labels)} objects in {len(found)} recordings: {folder}"
    finish(result, as_json=json, text=text)


PROCEDURAL = "procedural"

Out = Annotated[Path, typer.Option("--out", help="The dataset's folder; shards that are there are kept.")]
Count = Annotated[int, typer.Option("--count", min=1, help="Objects in all.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the first object; the others follow.")]
RigName = Annotated[
    str | None, typer.Option("--rig", show_default=PAPER_RIG, help="A packaged rig's name, or a rig's TOML file.")
]
SceneToml = Annotated[
    Path | None, typer.Option("--scene", help="A scene.toml: its rig, sensor, radiometry and material, not its object.")
]
HiddenObjects = Annotated[
    str, typer.Option("--objects", help=f"`{PROCEDURAL}`, or a folder of meshes (.obj, .stl, .ply) and its subfolders.")
]
LeftOut = Annotated[str, typer.Option("--without", help="Categories to leave out, by comma: hat,boat.")]
Backgrounds = Annotated[
    float, typer.Option("--backgrounds", min=0, max=1, help="Share of objects with a post or a panel beside them.")
]
Colour = Annotated[bool, typer.Option("--colour", help="Painted objects seen in red, green and blue; simulation only.")]
SpreadMm = Annotated[
    float, typer.Option("--rig-spread-mm", min=0, help="Each object's lidar and occluder are moved by up to this.")
]
SpreadDeg = Annotated[
    float,
    typer.Option("--rig-spread-deg", min=0, help="Each object's lidar is turned by up to this, in yaw and pitch."),
]
GainSpread = Annotated[
    float, typer.Option("--gain-spread-percent", min=0, help="Each object's intensity gain differs by up to this.")
]
Stop = Annotated[str, typer.Option("--accuracy", help="draft, standard or fine.")]
Workers = Annotated[
    int, typer.Option("--workers", min=1, show_default="as many as cores", help="Processes on this machine.")
]
RayAddress = Annotated[
    str | None,
    typer.Option("--ray", help="A Ray cluster does the work instead: auto, HOST:PORT, ray://HOST:PORT, local."),
]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    data = typer.Typer(help="Training data.")
    data.command("build")(build)
    add_label(data)
    app.add_typer(data, name="dataset")


def build(
    context: typer.Context,
    out: Out,
    count: Count,
    seed: Seed = 0,
    rig: RigName = None,
    scene: SceneToml = None,
    objects: HiddenObjects = PROCEDURAL,
    without: LeftOut = "",
    backgrounds: Backgrounds = 0.0,
    colour: Colour = False,
    rig_spread_mm: SpreadMm = 0.0,
    rig_spread_deg: SpreadDeg = 0.0,
    gain_spread_percent: GainSpread = 0.0,
    accuracy: Stop = "standard",
    workers: Workers = os.cpu_count() or 1,
    ray: RayAddress = None,
    json: Json = False,
) -> None:
    """Render random objects into HDF5 shards; run it again after a stop and it goes on."""
    kinds = _objects(objects, without, backgrounds)
    spread = RigSpread(place_m=rig_spread_mm / 1e3, angle_deg=rig_spread_deg, gain_share=gain_spread_percent / 100)
    others = {"accuracy": accuracy_named(accuracy).name, "objects": kinds, "spread": spread}
    others |= {"textures": tuple(TEXTURES) if colour else ()}
    plan = _plan(rig, scene, seed, others)
    built = _watched(plan, count, out, workers, ray, command_of(context, "build"))
    rate = built.made / built.seconds if built.made else None
    facts = {"objects": built.objects, "made": built.made, "damaged": [str(path) for path in built.damaged]}
    result = {**facts, "seconds": built.seconds, "objects_per_s": rate, "out": str(out)}
    told = f", {built.made} made now at {rate:.1f} objects/s" if rate else ""
    note = SIMULATION_ONLY if colour else ""
    finish(result, as_json=json, text=f"{built.objects} objects in {out}{told}", note=note)


def _objects(objects: str, without: str, backgrounds: float) -> Objects:
    if objects == PROCEDURAL:
        return Objects.without([name.strip() for name in without.split(",") if name.strip()], backgrounds)
    if without or backgrounds:
        raise typer.BadParameter("--without and --backgrounds are for procedural objects: leave them out")
    with tracked("reading meshes") as on_progress:
        return objects_of(Path(objects), on_progress)


def _plan(rig: str | None, scene: Path | None, seed: int, others: dict[str, Any]) -> DatasetPlan:
    if scene is None:
        return DatasetPlan(rig_named(rig or PAPER_RIG), seed, **others)
    if rig is not None:
        raise typer.BadParameter(f"{scene} has a rig of its own: leave out --rig")
    return DatasetPlan.of_scene(load_scene(scene), seed, **others)


class Rate(ProgressColumn):
    """Objects per second, once it is known."""

    def render(self, task: Task) -> Text:
        """The column's text."""
        return Text(f"{task.speed:.1f}/s" if task.speed else "")


def _watched(plan: DatasetPlan, count: int, out: Path, workers: int, ray: str | None, command: str) -> Built:
    farm = None
    if ray:
        from nlos_cam.dataset import cluster

        farm = cluster(ray)
    with progress(Rate()) as bar:
        tasks = [bar.add_task(name, total=None, visible=False) for name in ("checking shards", "rendering objects")]

        def shown(which: int, done: int, total: int) -> None:
            bar.update(tasks[which], completed=done, total=total, visible=which == 1 or done < total)

        try:
            return build_dataset(
                plan,
                count,
                out,
                workers=workers,
                on_progress=lambda done, total: shown(1, done, total),
                on_check=lambda done, total: shown(0, done, total),
                tell=say,
                command=command,
                farm=farm,
            )
        except KeyboardInterrupt:
            say(f"stopped: finished shards are kept in {out}; give the same command to go on")
            raise
