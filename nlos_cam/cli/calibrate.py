"""`nlos-cam calibrate`: measure the bench before using it."""

from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import dump_toml
from nlos_calibration.wall import DepthMean, fit_wall
from nlos_calibration.wall_record import WallRecord, wall_record
from rich.markup import escape

from nlos_cam.camera import open_camera
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, progress, tracked

Wall = Annotated[bool, typer.Option("--wall", help="Measure the bare wall: no object, no occluder.")]
CameraUri = Annotated[str | None, typer.Option("--camera", help="l515, l515:SERIAL, sim:bare-wall, ...")]
Bag = Annotated[Path | None, typer.Option("--bag", help="A recording of the bare wall.")]
Frames = Annotated[int, typer.Option("--frames", min=1, help="How many frames to average.")]
Out = Annotated[Path | None, typer.Option("--out", help="The record to write (TOML).")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(calibrate)


def calibrate(
    wall: Wall = False,
    camera: CameraUri = None,
    bag: Bag = None,
    frames: Frames = 60,
    out: Out = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Find the wall's distance and angle from frames of the bare wall, and write them as a record."""
    uri = _source(camera, bag, wall=wall)
    path = output_path(out, "wall", ".toml", overwrite=overwrite)
    mean, intrinsics = _average(uri, frames)
    fit = fit_wall(mean.mean_m(), intrinsics, np.random.default_rng(0))
    today = datetime.now().astimezone().date()
    record = wall_record(fit, intrinsics, camera=uri, frames=mean.frames, created=today)
    path.write_text(dump_toml(record), encoding="utf-8")
    measured = {
        "distance_m",
        "facing_deg",
        "yaw_deg",
        "pitch_deg",
        "residual_m",
        "inlier_fraction",
        "verdict",
        "frames",
    }
    result = record.model_dump(mode="json", include=measured) | {"out": str(path)}
    finish(result, as_json=json, text=_told(record, path))


def _source(camera: str | None, bag: Path | None, *, wall: bool) -> str:
    """The URI to read from. Raises typer.BadParameter for arguments that say too little or too much."""
    if not wall:
        raise typer.BadParameter("say what to measure: --wall")
    if bag is not None and camera is None:
        return f"bag:{bag}"
    if camera is not None and bag is None:
        return camera
    raise typer.BadParameter("give one of --camera URI and --bag F.bag")


def _average(uri: str, frames: int) -> tuple[DepthMean, Intrinsics]:
    """The mean depth over at most `frames` frames, and the intrinsics it was seen with."""
    with tracked("opening the camera") as on_progress:
        found = open_camera(uri, on_progress=on_progress)
    with found as source, progress() as bar:
        mean = DepthMean(source.intrinsics.height, source.intrinsics.width)
        for frame in bar.track(islice(source, frames), total=frames, description="looking at the wall"):
            mean.add(frame.depth_m)
        if mean.frames == 0:
            raise WallRefusedError(f"{uri} gave no frames: record the wall again, or look at it live")
        return mean, source.intrinsics


def _told(record: WallRecord, path: Path) -> str:
    colour = "green" if record.verdict == "good" else "yellow"
    angle = f"{record.facing_deg:.2f} degrees (yaw {record.yaw_deg:+z.2f}, pitch {record.pitch_deg:+z.2f})"
    return (
        f"distance  {record.distance_m:.4f} m\n"
        f"facing    {angle}\n"
        f"residual  {record.residual_m * 1e3:.2f} mm RMS, {record.inlier_fraction:.1%} of the depth on the plane\n"
        f"verdict   [bold {colour}]{record.verdict}[/]: {record.advice}\n"
        f"wrote {escape(str(path))}"
    )
