"""`nlos-cam calibrate`: measure the bench before using it."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from nlos_calibration.board import BOARDS, Board, Paper
from nlos_calibration.board_corners import IrMean
from nlos_calibration.board_wall import BoardRecord, WallByBoard, wall_with_board
from nlos_calibration.depth_mean import DepthMean
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.projection import Intrinsics
from nlos_calibration.range_offset import tape_the_wall
from nlos_calibration.rig import dump_toml
from nlos_calibration.wall import WallFit, fit_wall
from nlos_calibration.wall_record import WallRecord, wall_record
from rich.markup import escape

from nlos_cam.camera import open_camera
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, progress, tracked

Wall = Annotated[bool, typer.Option("--wall", help="Measure the bare wall: no object, no occluder.")]
CameraUri = Annotated[str | None, typer.Option("--camera", help="l515, l515:SERIAL, sim:bare-wall, ...")]
Bag = Annotated[Path | None, typer.Option("--bag", help="A recording of the bare wall.")]
Frames = Annotated[int, typer.Option("--frames", min=1, help="How many frames to average.")]
Tape = Annotated[
    float | None,
    typer.Option("--tape-m", min=0.01, help="Distance by hand, from the front glass to the wall along its normal."),
]
ByBoard = Annotated[bool, typer.Option("--board", help="Look for a printed board too (`nlos-cam board`), in infrared.")]
OnPaper = Annotated[Paper | None, typer.Option("--paper", help="The paper of the printed board; a4 if not given.")]
SquareMm = Annotated[
    float | None,
    typer.Option("--square-mm", min=1.0, help="Side of the board's squares as measured: its bar's length x 0.3."),
]
Out = Annotated[Path | None, typer.Option("--out", help="The record to write (TOML).")]
TOLD = {
    "distance_m",
    "distance_std_m",
    "facing_deg",
    "facing_std_deg",
    "yaw_deg",
    "yaw_std_deg",
    "pitch_deg",
    "pitch_std_deg",
    "range_offset_m",
    "board",
    "residual_m",
    "inlier_fraction",
    "verdict",
    "warnings",
    "frames",
}
"""What --json tells of the record."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(calibrate)


def calibrate(
    wall: Wall = False,
    camera: CameraUri = None,
    bag: Bag = None,
    frames: Frames = 60,
    tape_m: Tape = None,
    board: ByBoard = False,
    paper: OnPaper = None,
    square_mm: SquareMm = None,
    out: Out = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Find the wall's distance and angle from frames of the bare wall, and write them as a record."""
    uri = _source(camera, bag, wall=wall)
    if not board and (paper or square_mm):
        raise typer.BadParameter("--paper and --square-mm are of a board: add --board")
    if board and tape_m is not None:
        raise typer.BadParameter("give one of --tape-m and --board: each tells how far the lidar's range is off")
    path = output_path(out, "wall", ".toml", overwrite=overwrite)
    seen = _look(uri, frames)
    printed = BOARDS[paper or "a4"] if board else None
    fit, further = _with_board(seen, printed, square_mm) if printed else _fitted(seen, tape_m)
    today = datetime.now().astimezone().date()
    record = wall_record(
        fit,
        seen.intrinsics,
        camera=uri,
        frames=seen.mean.frames,
        created=today,
        others=seen.device | further,
    )
    path.write_text(dump_toml(record), encoding="utf-8")
    result = record.model_dump(mode="json", include=TOLD) | {"out": str(path)}
    finish(result, as_json=json, text=_told(record, path))


@dataclass(frozen=True)
class _Seen:
    """What was looked at, and by what."""

    mean: DepthMean
    infrared: IrMean
    intrinsics: Intrinsics
    device: dict[str, object]
    """Serial, firmware and settings, as the record names them."""


def _source(camera: str | None, bag: Path | None, *, wall: bool) -> str:
    """The URI to read from. Raises typer.BadParameter for arguments that say too little or too much."""
    if not wall:
        raise typer.BadParameter("say what to measure: --wall")
    if bag is not None and camera is None:
        return f"bag:{bag}"
    if camera is not None and bag is None:
        return camera
    raise typer.BadParameter("give one of --camera URI and --bag F.bag")


def _look(uri: str, frames: int) -> _Seen:
    """The mean depth over at most `frames` frames, and what it was seen with."""
    with tracked("opening the camera") as on_progress:
        found = open_camera(uri, on_progress=on_progress)
    with found as source, progress() as bar:
        shape = source.intrinsics.height, source.intrinsics.width
        mean, infrared = DepthMean(*shape), IrMean(*shape)
        settings: Mapping[str, float] = {}
        for frame in bar.track(islice(source, frames), total=frames, description="looking at the wall"):
            mean.add(frame.depth_m)
            infrared.add(frame.ir)
            settings = frame.settings
        if mean.frames == 0:
            raise WallRefusedError(f"{uri} gave no frames: record the wall again, or look at it live")
        device = {name: source.identity.get(name, "") for name in ("serial", "firmware")}
        return _Seen(mean, infrared, source.intrinsics, {**device, "settings": dict(settings)})


def _fitted(seen: _Seen, tape_m: float | None) -> tuple[WallFit, dict[str, object]]:
    """The wall, and what the record says of the lidar's offset where a distance was measured by hand."""
    depth_m, noise = seen.mean.mean_m(), seen.mean.noise()

    def fit_with(offset_m: float, origin_m: float) -> WallFit:
        return fit_wall(depth_m + offset_m, seen.intrinsics, np.random.default_rng(0), noise, origin_m)

    if tape_m is None:
        return fit_with(0.0, 0.0), {}
    taped = tape_the_wall(fit_with, tape_m)
    return taped.fit, {
        "range_offset_m": taped.offset_m,
        "range_offset_std_m": taped.offset_std_m,
        "range_offset_cause": taped.cause,
    }


def _with_board(
    seen: _Seen, printed: Board, square_mm: float | None
) -> tuple[WallFit | WallByBoard, dict[str, object]]:
    """The wall from depth, where that is not refused, and from a board."""
    depth: WallFit | WallRefusedError
    try:
        depth = _fitted(seen, None)[0]
    except WallRefusedError as error:
        depth = error
    board = printed if square_mm is None else printed.measured(square_mm)
    measured = square_mm is not None
    fit, record = wall_with_board(depth, seen.infrared.mean(), board, seen.intrinsics, measured=measured)
    return fit, {"board": record}


def _told(record: WallRecord, path: Path) -> str:
    """What was measured, with the half width of each 95 % interval."""
    colour = "green" if record.verdict == "good" else "yellow"
    facing, yaw, pitch = (
        f"{angle} ± {_interval(std):.4f}"
        for angle, std in (
            (f"{record.facing_deg:.2f}", record.facing_std_deg),
            (f"{record.yaw_deg:+z.2f}", record.yaw_std_deg),
            (f"{record.pitch_deg:+z.2f}", record.pitch_std_deg),
        )
    )
    lines = [
        f"distance  {record.distance_m:.4f} m ± {1e3 * _interval(record.distance_std_m):.4f} mm",
        f"facing    {facing} degrees (yaw {yaw}, pitch {pitch})",
    ]
    if record.residual_m is not None:
        share = f"{record.inlier_fraction:.1%} of the depth on the plane"
        lines.append(f"residual  {record.residual_m * 1e3:.2f} mm RMS, {share}")
    if record.board is not None:
        lines.append(f"board     {_board_told(record.board)}")
    if record.range_offset_std_m is not None:
        offset, interval = 1e3 * record.range_offset_m, 1e3 * _interval(record.range_offset_std_m)
        lines.append(f"offset    {offset:+.1f} ± {interval:.1f} mm of the lidar's {record.range_offset_cause}")
    lines.append(f"verdict   [bold {colour}]{record.verdict}[/]: {record.advice}")
    lines += [f"note      {warning}" for warning in record.warnings]
    return "\n".join([*lines, f"wrote {escape(str(path))}"])


def _interval(std: float | None) -> float:
    return 1.96 * (std or 0.0)


def _board_told(board: BoardRecord) -> str:
    found = f"{board.distance_m:.4f} m ± {1e3 * _interval(board.distance_std_m):.2f} mm, {board.facing_deg:.2f} degrees"
    found += f" ± {_interval(board.facing_std_deg):.3f}, by {board.corners} corners"
    if board.disagreement_m is None or board.disagreement_deg is None:
        return found
    apart = f"{1e3 * board.disagreement_m:+z.2f} mm and {board.disagreement_deg:.3f} degrees from the depth's plane"
    return f"{found}; {apart} ({board.disagreement_sigmas:.1f} sigma); used: {board.used}"
