"""`dataset build` renders training data, and `dataset label` makes it from labelled recordings."""

from __future__ import annotations

import os
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import nlos_calibration as walls
import nlos_models as models
import typer
from rich.progress import ProgressColumn, Task
from rich.text import Text

from nlos_cam import dataset as data
from nlos_cam import objects as shapes
from nlos_cam import render as renderer
from nlos_cam.cli import benches, common

PROCEDURAL = "procedural"

Out = Annotated[Path, typer.Option("--out", help="Folder of the dataset; shards in it are kept.")]
NewOut = Annotated[Path, typer.Option("--out", help="Folder of the dataset.")]
Count = Annotated[int, typer.Option("--count", min=1, help="Total number of objects.")]
Seed = Annotated[
    int, typer.Option("--seed", min=0, help="Seed of the first object; the others follow.")
]
RigName = Annotated[
    str | None,
    typer.Option(
        "--rig", show_default=common.PAPER_RIG, help="Name of a packaged rig, or a rig's TOML file."
    ),
]
SceneToml = Annotated[
    Path | None,
    typer.Option(
        "--scene",
        help="Scene file whose rig, sensor, radiometry and material to use, not its object.",
    ),
]
HiddenObjects = Annotated[
    str,
    typer.Option(
        "--objects",
        help=f"`{PROCEDURAL}`, or a folder of meshes (.obj, .stl, .ply) and its subfolders.",
    ),
]
LeftOut = Annotated[
    str, typer.Option("--without", help="Categories to leave out, separated by commas: hat,boat.")
]
Backgrounds = Annotated[
    float,
    typer.Option(
        "--backgrounds", min=0, max=1, help="Share of objects with a post or a panel beside them."
    ),
]
ShareGeneric = Annotated[
    float,
    typer.Option(
        "--share-generic",
        min=0,
        max=1,
        help="Share of generic shapes (solids, strokes, blobs, pairs, ...).",
    ),
]
Color = Annotated[
    bool,
    typer.Option(
        "--colour", help="Painted objects and maps in red, green and blue; simulation only."
    ),
]
SpreadMm = Annotated[
    float,
    typer.Option(
        "--rig-spread-mm",
        min=0,
        max=1000,
        help="Largest shift of lidar and occluder, drawn per object, in mm.",
    ),
]
SpreadDeg = Annotated[
    float,
    typer.Option(
        "--rig-spread-deg",
        min=0,
        max=90,
        help="Largest turn of the lidar in yaw and pitch, drawn per object.",
    ),
]
GainSpread = Annotated[
    float,
    typer.Option(
        "--gain-spread-percent",
        min=0,
        max=100,
        help="Largest change of the intensity gain, drawn per object.",
    ),
]
ObjectsPerRig = Annotated[
    int | None,
    typer.Option(
        "--objects-per-rig",
        min=1,
        help="Objects that share a draw of the spreads (default: 1, with --any-rig 25); 50 render 4"
        " times as fast.",
    ),
]
UpAxis = Annotated[
    Literal["y", "z"] | None,
    typer.Option("--up", help="Axis of the meshes of --objects that points up (default: y)."),
]
OffRecord = Annotated[
    bool,
    typer.Option(
        "--off-record",
        help="The rig's spread is not known: training sees benches that are off their record by it.",
    ),
]
AnyRig = Annotated[
    bool,
    typer.Option(
        "--any-rig",
        help="Draw a rig for every 25 objects, over all that the paper allows, for weights that"
        " know them all.",
    ),
]
Expected = Annotated[
    bool,
    typer.Option(
        "--expected-maps",
        help="Store maps without a draw of noise: `train direct` draws it anew at each step.",
    ),
]
AccuracyName = Annotated[
    Literal["draft", "standard", "fine", "reference"],
    typer.Option("--accuracy", help="Accuracy of the renderer."),
]
Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", min=1, show_default="as many as cores", help="Processes on this machine."
    ),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray", help="Ray cluster to use instead: auto, HOST:PORT, ray://HOST:PORT, local."
    ),
]
Backend = Annotated[
    Literal["cpu", "torch", "cuda"],
    typer.Option(
        "--backend",
        help="cpu: processes; cuda: a GPU, in batches; torch: the same on the CPU, to try it.",
    ),
]
Transients = Annotated[
    bool,
    typer.Option(
        "--transient",
        help="Write each object's transient too, in tal's HDF5: OUT/transients/SEED.hdf5.",
    ),
]
Recordings = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder of recordings with labels.")
]
Wall = Annotated[
    Path | None,
    typer.Option("--wall", help="Wall record of the bench, as for `live`: corrects the maps."),
]
Frames = Annotated[
    int, typer.Option("--frames", min=1, help="Frames per recording, evenly spread over it.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of the group `dataset`."""
    group = typer.Typer(help="Training data.")
    group.command("build")(build)
    group.command("label")(label)
    app.add_typer(group, name="dataset")


def build(
    context: typer.Context,
    out: Out,
    count: Count,
    seed: Seed = 0,
    rig: RigName = None,
    bench_folder: benches.BenchOrRig = None,
    scene: SceneToml = None,
    objects: HiddenObjects = PROCEDURAL,
    without: LeftOut = "",
    backgrounds: Backgrounds = 0.0,
    share_generic: ShareGeneric = 0.0,
    up: UpAxis = None,
    colour: Color = False,
    rig_spread_mm: SpreadMm = 0.0,
    rig_spread_deg: SpreadDeg = 0.0,
    gain_spread_percent: GainSpread = 0.0,
    off_record: OffRecord = False,
    any_rig: AnyRig = False,
    objects_per_rig: ObjectsPerRig = None,
    accuracy: AccuracyName = "standard",
    expected_maps: Expected = False,
    workers: Workers = None,
    ray: RayAddress = None,
    backend: Backend = "cpu",
    transient: Transients = False,
    json: common.Json = False,
) -> None:
    """Render random objects into HDF5 shards; give the same command again to resume after an
    interruption.
    """
    if scene and (rig or bench_folder):
        raise typer.BadParameter(f"{scene} has its own rig: drop --rig and --bench")
    its_rig = benches.rig_or_default(bench_folder, rig, common.PAPER_RIG)
    spread = data.RigSpread(
        place_m=rig_spread_mm / 1e3, angle_deg=rig_spread_deg, gain_share=gain_spread_percent / 100
    )
    bare = renderer.load_scene(scene) if scene else renderer.SceneFile(name="bare", rig=its_rig)
    box = shapes.object_box(bare.rig)
    plan = data.DatasetPlan.of_scene(
        bare,
        seed,
        objects=_objects(objects, without, backgrounds, share_generic, up, box),
        accuracy=renderer.accuracy_named(accuracy).name,
        spread=spread,
        textures=tuple(shapes.TEXTURES) if colour else (),
        expected=expected_maps,
        objects_per_rig=objects_per_rig or (data.OBJECTS_PER_RIG if any_rig else 1),
        off_record=off_record,
        rigs=data.RigRange() if any_rig else None,
    )
    farm = rendering_farm(ray, backend, workers)
    workers = workers or os.cpu_count() or 1
    try:
        report = _build(plan, count, out, workers, _command(context, "build"), farm)
        if transient:
            with common.tracked("rendering transients") as on_progress:
                data.build_transients(plan, count, out, on_progress)
    except KeyboardInterrupt:
        kept = "finished shards and transients are" if transient else "finished shards are"
        common.exit_interrupted(f"{kept} kept in {out}; give the same command to resume")
    rate = report.objects_per_s
    facts = {
        "objects": report.objects,
        "made": report.made,
        "damaged": [str(path) for path in report.damaged],
    }
    result = {**facts, "seconds": report.seconds, "objects_per_s": rate, "out": str(out)}
    new = f" ({report.made} new, {rate:.1f} per second)" if rate else ""
    note = models.SIMULATION_ONLY if colour else ""
    common.finish(result, as_json=json, text=f"{report.objects} objects in {out}{new}", note=note)


def _build(
    plan: data.DatasetPlan,
    count: int,
    out: Path,
    workers: int,
    command: str,
    farm: data.Farm | None,
) -> data.BuildReport:
    """Build a dataset with bars of its progress."""
    with common.progress(Rate()) as bar:
        checks, renders = (
            bar.add_task(name, total=None, visible=False)
            for name in ("checking shards", "rendering")
        )
        return data.build_dataset(
            plan,
            count,
            out,
            workers=workers,
            on_progress=lambda done, total: bar.update(
                renders, completed=done, total=total, visible=True
            ),
            on_check=lambda done, total: bar.update(
                checks, completed=done, total=total, visible=done < total
            ),
            on_warning=common.say,
            command=command,
            farm=farm,
        )


def rendering_farm(ray: str | None, backend: str, workers: int | None) -> data.Farm | None:
    """Return the farm that renders in place of processes on this machine; None for these. Raises
    typer.BadParameter for two, and for a number of `workers` beside one.
    """
    if ray and backend != "cpu":
        raise typer.BadParameter(f"--ray and --backend {backend} each say who renders: give one")
    if workers and (ray or backend != "cpu"):
        raise typer.BadParameter(
            "--workers counts processes on this machine, of which none renders with --ray or"
            " --backend: drop one"
        )
    if ray:
        return data.ray_farm(ray)
    return None if backend == "cpu" else data.in_batches(backend)


def label(
    context: typer.Context,
    recordings: Recordings,
    out: NewOut,
    wall: Wall = None,
    bench_folder: benches.BenchFolder = None,
    frames: Frames = 8,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Make a dataset from labelled recordings of known objects: maps of single frames, as `live`
    gives them to the bench's own weights, with the hidden depth.

    A label is the name of a benchmark object, or of files beside the recordings: LABEL.truth.toml
    (the fields of a scene file's object; by default of the mesh LABEL.stl, .obj or .ply), or
    LABEL.npy (a depth map).
    """
    chosen = benches.choose(bench_folder, wall, reconstructs=False)
    folder = common.output_path(out, "dataset", "", overwrite=overwrite)
    with common.tracked("reading recordings") as on_progress:
        command = _command(context, "label")
        labelled = data.label_recordings(
            recordings,
            folder,
            wall=chosen.open if chosen.bench else wall,
            frames=frames,
            command=command,
            on_progress=on_progress,
        )
    samples = len(labelled.label)
    labels = sorted(set(labelled.label))
    files = len(set(labelled.recording))
    rig = {"rig_name": labelled.rig.name, "rig_checksum": labelled.rig.checksum}
    result = {"out": str(folder), "samples": samples, "recordings": files, "labels": labels, **rig}
    text = f"{samples} samples of {len(labels)} objects from {files} recordings in {folder}"
    common.finish(result, as_json=json, text=text)


def _command(context: typer.Context, name: str) -> str:
    """Return the command line to repeat: arguments, and all options except --json with their
    values.
    """
    words = ["nlos-cam", "dataset", name]
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if value is None or value is False or parameter.name == "json":
            continue
        option = [] if parameter.param_type_name == "argument" else [parameter.opts[0]]
        words += option if value is True else [*option, str(value)]
    return shlex.join(words)


def _objects(
    objects: str,
    without: str,
    backgrounds: float,
    share_generic: float,
    up: shapes.Up | None,
    box: walls.ObjectBox,
) -> data.Objects:
    if objects == PROCEDURAL:
        if up:
            raise typer.BadParameter("--up is for the meshes of a folder: drop it")
        left_out = [name.strip() for name in without.split(",") if name.strip()]
        return data.Objects.without(left_out, backgrounds, share_generic)
    if without or backgrounds:
        raise typer.BadParameter(
            "--without and --backgrounds are for procedural objects: drop them"
        )
    with common.tracked("reading meshes") as on_progress:
        meshes = data.objects_from_folder(Path(objects), box, up or "y", on_progress)
    return replace(meshes, share_generic=share_generic)


class Rate(ProgressColumn):
    """Progress column of objects per second."""

    def render(self, task: Task) -> Text:
        """Return the rate, empty until it is known."""
        return Text(f"{task.speed:.1f}/s" if task.speed else "")
