"""`nlos-cam calibrate`: measure the bench before using it."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from nlos_calibration.board import BOARDS, Paper
from nlos_calibration.board_corners import Light
from nlos_calibration.board_view import BoardView
from nlos_calibration.board_wall import WallByBoard
from nlos_calibration.measured_wall import load_measured
from nlos_calibration.wall import WallFit
from nlos_calibration.wall_record import OccluderRecord, WallRecord, wall_record
from numpy.typing import NDArray

from nlos_cam.calibrate.color_view import look_in_colour
from nlos_cam.calibrate.files import WallFiles, written
from nlos_cam.calibrate.measure import Seen, by_board, by_depth, by_occluder, look
from nlos_cam.camera import open_camera
from nlos_cam.camera.protocol import Camera
from nlos_cam.cli.calibrate_told import told
from nlos_cam.cli.calibrate_watch import watch_until_enter
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, progress, tracked

Wall = Annotated[bool, typer.Option("--wall", help="Measure the bare wall: no object, no occluder.")]
CameraUri = Annotated[str | None, typer.Option("--camera", help="l515, l515:SERIAL, sim:bare-wall, ...")]
Bag = Annotated[Path | None, typer.Option("--bag", help="A recording of the bare wall.")]
BareRecord = Annotated[
    Path | None,
    typer.Option("--occluder", help="Measure the occluder that stands now; the bare wall's record (wall.toml)."),
]
Frames = Annotated[int, typer.Option("--frames", min=1, help="How many frames to average.")]
Watch = Annotated[bool, typer.Option("--watch", help="First show distance and angle live, until Enter is pressed.")]
Tape = Annotated[
    float | None,
    typer.Option("--tape-m", min=0.01, help="Distance by hand, from the front glass to the wall along its normal."),
]
ByBoard = Annotated[bool, typer.Option("--board", help="Look for a printed board too (`nlos-cam board`).")]
BoardIn = Annotated[
    Light, typer.Option("--board-in", help="Where the board is looked for: colour needs an L515, or a recording of it.")
]
OnPaper = Annotated[Paper | None, typer.Option("--paper", help="The paper of the printed board; a4 if not given.")]
SquareMm = Annotated[
    float | None,
    typer.Option("--square-mm", min=1.0, help="Side of the board's squares as measured: its bar's length x 0.3."),
]
OccluderX = Annotated[
    float | None,
    typer.Option("--occluder-x-m", min=0.01, help="Where the occluder will stand, from the lidar's foot, by hand."),
]
OccluderGap = Annotated[
    float | None, typer.Option("--occluder-gap-m", min=0.001, help="From the occluder's edge to the wall, by hand.")
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
    "footprint_share",
    "occluder",
    "board",
    "residual_m",
    "inlier_fraction",
    "verdict",
    "advice",
    "warnings",
    "frames",
    "reference",
}
"""What --json tells of the record."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(calibrate)


def calibrate(
    wall: Wall = False,
    camera: CameraUri = None,
    bag: Bag = None,
    occluder: BareRecord = None,
    frames: Frames = 60,
    watch: Watch = False,
    tape_m: Tape = None,
    board: ByBoard = False,
    board_in: BoardIn = "infrared",
    paper: OnPaper = None,
    square_mm: SquareMm = None,
    occluder_x_m: OccluderX = None,
    occluder_gap_m: OccluderGap = None,
    out: Out = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Find the wall's distance and angle from frames of the bare wall, and write them as a record, with a report.

    Beside wall.toml lie wall.npz, the bare wall as difference maps need it, and wall.html, the report. Once the
    occluder stands, --occluder wall.toml finds it and takes a new reference, with nothing hidden yet.
    """
    uri = _source(camera, bag, wall=wall, occluder=occluder)
    if not board and (paper or square_mm or board_in == "colour"):
        raise typer.BadParameter("--paper, --square-mm and --board-in are of a board: add --board")
    if board and tape_m is not None:
        raise typer.BadParameter("give one of --tape-m and --board: each tells how far the lidar's range is off")
    by_hand = _entered(occluder_x_m, occluder_gap_m)
    if occluder and (board or tape_m is not None or by_hand):
        raise typer.BadParameter("--occluder finds the occluder beside a wall that was measured: give it alone")
    if occluder and watch:
        raise typer.BadParameter("--watch shows the bare wall: position the lidar with it, then add the occluder")
    bare = load_measured(occluder) if occluder else None
    files = WallFiles.beside(output_path(out, "wall", ".toml", overwrite=overwrite), overwrite=overwrite)
    if watch:
        watch_until_enter(_opened(uri))
    colour = _look_in_colour(uri, frames) if board_in == "colour" else None
    seen = _look(uri, frames)
    inliers: NDArray[np.bool_] | None
    if bare:
        record, inliers = by_occluder(seen, bare)
    else:
        fit, facts = by_board(seen, BOARDS[paper or "a4"], square_mm, colour) if board else by_depth(seen, tape_m)
        record, inliers = _record(seen, fit, facts, by_hand), fit.inliers if isinstance(fit, WallFit) else None
    record = written(files, record, None if inliers is None else seen.reference(inliers))
    result = record.model_dump(mode="json", include=TOLD) | {"out": str(files.record), "report": str(files.report)}
    finish(result, as_json=json, text=told(record, files), marked=True)


def _source(camera: str | None, bag: Path | None, *, wall: bool, occluder: Path | None) -> str:
    """The URI to read from. Raises typer.BadParameter for arguments that say too little or too much."""
    if wall == (occluder is not None):
        raise typer.BadParameter("say what to measure: --wall, or --occluder wall.toml once the wall is known")
    if bag is not None and camera is None:
        return f"bag:{bag}"
    if camera is not None and bag is None:
        return camera
    raise typer.BadParameter("give one of --camera URI and --bag F.bag")


def _entered(x_m: float | None, gap_m: float | None) -> OccluderRecord | None:
    """The occluder as somebody says it stands. Raises typer.BadParameter for half of it."""
    if x_m is None and gap_m is None:
        return None
    if x_m is None or gap_m is None:
        raise typer.BadParameter("an occluder has a place and a gap: give --occluder-x-m and --occluder-gap-m")
    return OccluderRecord(source="entered", x_m=x_m, gap_m=gap_m)


def _opened(uri: str) -> Camera:
    with tracked("opening the camera") as on_progress:
        return open_camera(uri, on_progress=on_progress)


def _look(uri: str, frames: int) -> Seen:
    """What at most `frames` frames show."""
    with _opened(uri) as source, progress() as bar:
        task = bar.add_task("looking at the wall", total=frames)
        return look(source, frames, lambda: bar.advance(task))


def _look_in_colour(uri: str, frames: int) -> BoardView:
    """The mean colour image; a device is looked at in colour before it is in depth."""
    with progress() as bar:
        task = bar.add_task("looking in colour", total=frames)
        return look_in_colour(uri, frames, on_frame=lambda: bar.advance(task))


def _record(
    seen: Seen, fit: WallFit | WallByBoard, facts: dict[str, object], occluder: OccluderRecord | None
) -> WallRecord:
    """The record of a wall that was measured now."""
    return wall_record(
        fit,
        seen.intrinsics,
        camera=seen.camera,
        frames=seen.statistics.depth.frames,
        created=datetime.now().astimezone().date(),
        occluder=occluder,
        others={**seen.facts(), **facts},
    )
