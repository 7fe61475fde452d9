"""`render`: the maps that the lidar would report of one hidden object, as numbers and a picture."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import nlos_calibration as walls
import typer
from rich.table import Table

from nlos_cam import objects
from nlos_cam import render as renderer
from nlos_cam.cli import benches
from nlos_cam.cli import transients as transient_options
from nlos_cam.cli.common import PAPER_RIG, Json, Overwrite, finish, output_path, say, stderr

if TYPE_CHECKING:
    from nlos_calibration.arrays import Float32

DEFAULTS = {
    "seed": 0,
    "up": "y",
    "size_m": 0.18,
    "tilt_x_deg": 0.0,
    "tilt_y_deg": 0.0,
    "turn_deg": 0.0,
    "x_m": 0.0,
    "y_m": 0.0,
    "front_m": 0.03,
}
"""Defaults of HiddenObject, for the help page, which does not wait for its import."""
Stop = Annotated[
    Literal["draft", "standard", "fine", "reference"] | None,
    typer.Option("--accuracy", help="Stop of the accuracy setting.", show_default="standard"),
]
MaxError = Annotated[
    float | None,
    typer.Option(
        "--max-error", help="Use the fastest accuracy with this relative peak error or less."
    ),
]
MaxSeconds = Annotated[
    float | None,
    typer.Option(
        "--max-seconds", help="Use the best accuracy that renders within this many seconds."
    ),
]
BeamsPerCell = Annotated[
    int | None, typer.Option("--beams-per-cell", help="Beams along each axis of a map cell.")
]
EffectNames = Annotated[
    str,
    typer.Option(
        "--effects",
        help=(
            f"auto (those that matter in the scene), or a list from: {', '.join(renderer.EFFECTS)}."
        ),
    ),
]
Backend = Annotated[
    Literal["cpu", "torch", "cuda"],
    typer.Option("--backend", help="Processor; torch runs the GPU code on the CPU."),
]
RadiometryName = Annotated[
    Literal["paper", "lambertian"] | None,
    typer.Option("--radiometry", help="S1 to S5, or the rendering equation."),
]
MaterialKind = Annotated[
    Literal["lambertian", "phong", "retroreflective"] | None,
    typer.Option("--material", help="Kind of the surface."),
]
Specular = Annotated[
    float | None, typer.Option("--specular", help="Share of the albedo in the specular lobe.")
]
Exponent = Annotated[
    float | None, typer.Option("--exponent", help="Exponent of the lobe; larger is narrower.")
]
Albedo = Annotated[
    str | None, typer.Option("--albedo", help="Albedo from 0 to 1: one number, or red,green,blue.")
]
PulseNs = Annotated[
    float | None,
    typer.Option(
        "--pulse-ns", min=0, max=100, help="Full width of the pulse at half maximum, in ns."
    ),
]


def scene_of(
    bare: renderer.Scene,
    own: renderer.Material,
    material: dict[str, Any],
    options: dict[str, Any],
) -> renderer.Scene:
    """Return a scene with the options that are not None: fields that replace those of the scene's
    own Material, and fields of Scene.

    Raises typer.BadParameter or SceneError with the field, the value and the range.
    """
    from pydantic import ValidationError

    given = {name: value for name, value in material.items() if value is not None}
    if isinstance(text := given.get("albedo"), str):
        given["albedo"] = _numbers(text)
    if given:
        try:
            changed = renderer.Material(**{**dict(own), **given})
        except ValidationError as error:
            raise typer.BadParameter(_as_option(walls.first_problem(error))) from error
        if changed.kind == "lambertian" and given.keys() & {"specular", "exponent"}:
            raise typer.BadParameter(
                "--specular and --exponent are of a lobe, which a Lambertian surface lacks: add"
                " --material phong or --material retroreflective"
            )
        bare = replace(bare, surface=changed.surface)
    return replace(bare, **{name: value for name, value in options.items() if value is not None})


def _as_option(problem: str) -> str:
    """Return "--size-m must be ..." for a problem of the field size_m."""
    field, _, text = problem.partition(": ")
    return f"--{field.partition('.')[0].replace('_', '-')} {text}"


def _numbers(text: str) -> float | tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(
            f"--albedo takes 1 number or 3 with commas between, got {text!r}"
        ) from error
    return values[0] if len(values) == 1 else values


def accuracy_of(
    stop: str | None,
    max_error: float | None,
    max_seconds: float | None,
    beams_per_cell: int | None,
) -> renderer.Accuracy:
    """Return the setting of a stop, or the one that keeps a bound. Raises typer.BadParameter for
    both.
    """
    if max_error is None and max_seconds is None:
        setting = renderer.accuracy_named(stop or "standard")
        return (
            setting if beams_per_cell is None else replace(setting, beams_per_cell=beams_per_cell)
        )
    if stop is not None or beams_per_cell is not None:
        raise typer.BadParameter(
            "--max-error and --max-seconds choose the accuracy: drop --accuracy and"
            " --beams-per-cell"
        )
    chosen = renderer.choose(max_error, max_seconds)
    say(f"Accuracy: {chosen}")
    return renderer.accuracy_named(chosen.stop)


def _option(field: str, text: str) -> Any:
    """Return an option named like a field of HiddenObject: None unless set."""
    return typer.Option(
        f"--{field.replace('_', '-')}", help=text, show_default=str(DEFAULTS[field])
    )


Object = Annotated[
    str,
    typer.Argument(
        metavar="OBJECT",
        help="A category's name, a mesh (.obj, .stl, .ply), a .npy depth map (n, n) in metres.",
    ),
]
Seed = Annotated[int | None, _option("seed", "Number of the category's variation.")]
UpAxis = Annotated[
    Literal["y", "z"] | None,
    _option("up", "Axis of a mesh that points up; its -z (z up: its +y) faces the wall."),
]
Size = Annotated[
    float | None,
    _option("size_m", "Size in meters: the larger extent along x and y after turning."),
]
TiltX = Annotated[
    float | None, _option("tilt_x_deg", "Rotation about the wall's x in degrees, applied first.")
]
TiltY = Annotated[
    float | None,
    _option("tilt_y_deg", "Then about the wall's y (up): at 180 its back faces the wall."),
]
Turn = Annotated[float | None, _option("turn_deg", "Then about the wall's z.")]
OffsetX = Annotated[
    float | None, _option("x_m", "Offset from the box's middle in meters, away from the lidar.")
]
OffsetY = Annotated[float | None, _option("y_m", "Offset from the box's middle in meters, up.")]
Front = Annotated[
    float | None,
    _option("front_m", "Gap in meters from the box to the object; deep objects are flattened."),
]


def hidden_depth(hidden: str, rig: walls.Rig, options: dict[str, Any]) -> Float32:
    """Return the depth map (n, n) of OBJECT over the rig's object box; `options` are fields of
    HiddenObject, or None.

    Prints on stderr how the box changes it. Raises SceneError for an object that cannot be loaded
    or placed, and typer.BadParameter for options that do not apply to it or are out of range.
    """
    from pydantic import ValidationError

    given = {name: value for name, value in options.items() if value is not None}
    kind = objects.object_kind(hidden)
    unused = {"category": {"up"}, "mesh": {"seed"}, "depth map": set(given)}[kind]
    if extra := [f"--{name.replace('_', '-')}" for name in given if name in unused]:
        raise typer.BadParameter(
            f"{hidden} is a {kind}, to which {', '.join(extra)} does not apply: drop it"
        )
    if kind == "depth map":
        loaded = objects.load_object(hidden, objects.object_box(rig))
    else:
        up: objects.Up = given.pop("up", "y")
        try:
            rest = renderer.HiddenObject(
                category=next(iter(objects.CATEGORIES)), **given
            )  # only checks the ranges of scene files
        except ValidationError as error:
            raise typer.BadParameter(_as_option(walls.first_problem(error))) from error
        pose = renderer.SceneFile(name=hidden, rig=rig).pose_at(rest, 0)
        loaded = objects.load_object(hidden, objects.object_box(rig), pose, seed=rest.seed, up=up)
    for warning in loaded.warnings:
        say(warning)
    return loaded.depth_m


def render(
    hidden: Object,
    out: Annotated[
        Path | None, typer.Option("--out", help="Output (.npz), with a picture (.png) beside it.")
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option("--scene", help="A scene.toml, of which OBJECT replaces the object."),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig", help="Name of a packaged rig, or a rig's TOML file.", show_default=PAPER_RIG
        ),
    ] = None,
    bench_folder: benches.BenchOrRig = None,
    accuracy: Stop = None,
    max_error: MaxError = None,
    max_seconds: MaxSeconds = None,
    seed: Seed = None,
    up: UpAxis = None,
    size_m: Size = None,
    tilt_x_deg: TiltX = None,
    tilt_y_deg: TiltY = None,
    turn_deg: Turn = None,
    x_m: OffsetX = None,
    y_m: OffsetY = None,
    front_m: Front = None,
    radiometry: RadiometryName = None,
    material: MaterialKind = None,
    specular: Specular = None,
    exponent: Exponent = None,
    albedo: Albedo = None,
    pulse_ns: PulseNs = None,
    beams_per_cell: BeamsPerCell = None,
    effects: EffectNames = "auto",
    backend: Backend = "cpu",
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the included effects, with reasons and costs.")
    ] = False,
    transient: transient_options.TransientFile = None,
    capture: transient_options.CaptureName = "lidar",
    wall_cells: transient_options.WallCells = None,
    wall_extent: transient_options.WallExtent = None,
    laser: transient_options.LaserPoint = None,
    bin_mm: transient_options.BinMm = None,
    start_m: transient_options.StartM = 0.0,
    bins: transient_options.Bins = None,
    wall_to_wall: transient_options.WallToWall = False,
    photons: transient_options.Photons = None,
    background: transient_options.Background = 0.0,
    noise_seed: transient_options.NoiseSeed = 0,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Render the maps that a lidar which reports its strongest echo gets of a hidden object."""
    if scene and (bench_folder or rig):
        raise typer.BadParameter("--scene, --bench and --rig each name a rig: give one")
    if out is not None and (not out.name or out.suffix not in {"", ".npz", ".png"}):
        raise typer.BadParameter(
            f"--out {out}: choose a name that ends in .npz; the picture has the same name in .png"
        )
    for_transient = transient_options.CaptureOptions(
        capture=capture,
        wall_cells=wall_cells,
        wall_extent=wall_extent,
        laser=laser,
        bin_mm=bin_mm,
        start_m=start_m,
        bins=bins,
        wall_to_wall=wall_to_wall,
        photons=photons,
        background=background,
        noise_seed=noise_seed,
    )
    if transient is not None:
        if out is not None or explain or effects != "auto":
            raise typer.BadParameter(
                "--transient writes no maps and takes all effects: drop --out, --explain, --effects"
            )
        for_transient.check_backend(backend)
        path = transient_options.transient_path(transient, overwrite=overwrite)
    else:
        for_transient.refuse_unused()
        path = output_path(out and out.with_suffix(".npz"), "render", ".npz", overwrite=overwrite)
        output_path(path.with_suffix(".png"), "render", ".png", overwrite=overwrite)
    file = renderer.load_scene(scene) if scene else None
    its_rig = benches.rig_or_default(bench_folder, rig, PAPER_RIG)
    bare = file.bare if file else renderer.Scene(its_rig)
    surface = {"kind": material, "specular": specular, "exponent": exponent, "albedo": albedo}
    own = file.hidden.material if file and file.hidden else renderer.Material()
    bare = scene_of(bare, own, surface, {"radiometry": radiometry, "pulse_ns": pulse_ns})
    angles = {"tilt_x_deg": tilt_x_deg, "tilt_y_deg": tilt_y_deg, "turn_deg": turn_deg}
    place = {"size_m": size_m, "x_m": x_m, "y_m": y_m, "front_m": front_m}
    depth_m = hidden_depth(hidden, bare.rig, {"seed": seed, "up": up, **angles, **place})
    target = replace(bare, object_depth_m=depth_m)
    wanted: renderer.Effects = (
        "auto" if effects == "auto" else [name for name in effects.split(",") if name]
    )
    setting = accuracy_of(accuracy, max_error, max_seconds, beams_per_cell)
    if transient is not None:
        transient_options.write_transient(
            path, target, for_transient.to_capture(), setting, backend, as_json=json
        )
        return
    start_s = time.perf_counter()
    rendering = renderer.render(target, setting, wanted, backend)
    seconds = time.perf_counter() - start_s
    _save(path, target, depth_m, rendering)
    title = (
        f"{hidden}{'' if seed is None else f' {seed}'} on {bare.rig.name}, accuracy"
        f" {setting.name!r}"
    )
    _draw(path.with_suffix(".png"), title, depth_m, rendering)
    sensor = file.sensor if file else renderer.SensorModel()
    measured = explain and setting.sub_bins > 0
    verdicts = _effects(target, rendering, sensor, backend, measured=measured)
    if explain:
        stderr.print(_table(verdicts))
    facts = {"seconds": seconds, "accuracy": setting.name, "near_legs": rendering.near_legs}
    text = f"Rendered at {setting.name!r} in {seconds:.2f} s: {path}, {path.with_suffix('.png')}"
    finish({**facts, "effects": verdicts, "out": str(path)}, as_json=json, text=text)


def _save(
    path: Path, scene: renderer.Scene, depth_m: Float32, rendering: renderer.Rendering
) -> None:
    import numpy as np

    from nlos_cam.files import atomic_file

    arrays = {
        "depth_m": rendering.depth_m,
        "intensity": rendering.intensity,
        "margin": rendering.margin,
        "object_depth_m": depth_m,
        "rig_name": np.array(scene.rig.name),
        "rig_checksum": np.array(scene.rig.checksum),
        "radiometry": np.array(scene.radiometry),
    }
    if rendering.color is not None:
        arrays["colour"] = rendering.color
    with atomic_file(path) as part:
        np.savez_compressed(part, allow_pickle=False, **arrays)


MARGIN_POWER = 0.3


def _effects(
    scene: renderer.Scene,
    rendering: renderer.Rendering,
    sensor: renderer.SensorModel,
    backend: str,
    *,
    measured: bool,
) -> list[dict[str, Any]]:
    """Return the verdicts as facts, with the seconds that each effect of the renderer costs if
    `measured`.
    """
    seconds = renderer.costs(scene, rendering.accuracy, rendering.plan, backend) if measured else {}
    effects = *rendering.plan, *renderer.sensor_effects(sensor)
    return [{**asdict(effect), "seconds": seconds.get(effect.name)} for effect in effects]


def _table(effects: list[dict[str, Any]]) -> Table:
    table = Table("effect", "included", "because", "bound", "adds")
    for effect in effects:
        cost = "" if effect["seconds"] is None else f"{1000 * effect['seconds']:.1f} ms"
        figures = f"{effect['bound']:.2g}", cost
        table.add_row(
            effect["name"], "yes" if effect["included"] else "no", effect["reason"], *figures
        )
    return table


def _draw(path: Path, title: str, depth_m: Float32, rendering: renderer.Rendering) -> None:
    from matplotlib.colors import PowerNorm

    from nlos_cam.files import atomic_file
    from nlos_cam.report import figure_of

    figure = figure_of(13, 3.3)
    maps: dict[str, tuple[Float32, dict[str, Any]]] = {
        "hidden depth (cm from the wall)": (100 * depth_m, {"cmap": "inferno_r"}),
        "lidar depth (cm)": (100 * rendering.depth_m, {"cmap": "inferno_r"}),
        "lidar intensity (in units of $I_0$)": (rendering.intensity, {"cmap": "gray"}),
        # Where the object wins, the margin is some hundredths: it is black on a plain scale.
        "margin of the winning echo (0: a tie)": (
            rendering.margin,
            {"cmap": "cividis", "norm": PowerNorm(MARGIN_POWER, 0.0, 1.0)},
        ),
    }
    for axis, (name, (image, style)) in zip(
        figure.subplots(1, len(maps)), maps.items(), strict=True
    ):
        figure.colorbar(axis.imshow(image, **style), ax=axis)
        axis.set_title(name, fontsize=10)
        axis.axis("off")
    figure.suptitle(title)
    with atomic_file(path) as part:
        figure.savefig(part, dpi=100)
