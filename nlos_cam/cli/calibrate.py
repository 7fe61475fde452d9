"""`nlos-cam calibrate`: measure the bench before using it.

What a person is told of a calibration.

`calibrate --watch`: distance and angle on the terminal, ten times a second, while somebody positions the rig.

`nlos-cam board`: print a board that tells the wall where the lidar's depth does not.
"""

import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from threading import Event, Thread
from typing import Annotated

import numpy as np
import typer
from nlos_calibration import (
    BOARDS,
    DISTANCE_RANGE_M,
    FACING_RANGE_DEG,
    INTERVAL_STDS,
    PAPER_MM,
    BoardRecord,
    BoardView,
    Light,
    OccluderRecord,
    Paper,
    WallByBoard,
    WallFit,
    WallRecord,
    load_measured,
    new_wall_record,
)
from numpy.typing import NDArray
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from nlos_cam.calibrate import (
    CaptureStatistics,
    Glance,
    WallFiles,
    by_board,
    by_depth,
    by_occluder,
    glance,
    look,
    look_in_colour,
    write_sheet,
    written,
)
from nlos_cam.camera import Camera, open_camera
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, progress, say, stderr, tracked
from nlos_cam.frames import MAX_SATURATED


def told(record: WallRecord, files: WallFiles) -> str:
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
    if record.occluder is not None:
        lines.append(f"occluder  {_occluder_told(record.occluder)}")
    if record.footprint_share is not None:
        lines.append(f"footprint {record.footprint_share:.0%} of the map's cells are on the wall")
    if record.board is not None:
        lines.append(f"board     {_board_told(record.board)}")
    if record.range_offset_std_m is not None:
        offset, interval = 1e3 * record.range_offset_m, 1e3 * _interval(record.range_offset_std_m)
        lines.append(f"offset    {offset:+.1f} ± {interval:.1f} mm of the lidar's {record.range_offset_cause}")
    lines.append(f"verdict   [bold {colour}]{record.verdict}[/]: {record.advice}")
    lines += [f"note      {warning}" for warning in record.warnings]
    beside = [files.reference.name] if record.reference else []
    return "\n".join([*lines, f"wrote {escape(', '.join([str(files.record), *beside, files.report.name]))}"])


def _interval(std: float | None) -> float:
    return INTERVAL_STDS * (std or 0.0)


def _occluder_told(occluder: OccluderRecord) -> str:
    if occluder.x_std_m is None or occluder.gap_std_m is None:
        return f"{occluder.x_m:.3f} m from the foot, {occluder.gap_m:.3f} m off the wall (entered)"
    x, gap = 1e3 * _interval(occluder.x_std_m), 1e3 * _interval(occluder.gap_std_m)
    return f"{occluder.x_m:.4f} m ± {x:.2f} mm from the foot, {occluder.gap_m:.4f} m ± {gap:.2f} mm off the wall"


def _board_told(board: BoardRecord) -> str:
    found = f"{board.distance_m:.4f} m ± {1e3 * _interval(board.distance_std_m):.2f} mm, {board.facing_deg:.2f} degrees"
    found += f" ± {_interval(board.facing_std_deg):.3f}, by {board.corners} corners"
    if board.disagreement_m is None or board.disagreement_deg is None:
        return found
    apart = f"{1e3 * board.disagreement_m:+z.2f} mm and {board.disagreement_deg:.3f} degrees from the depth's plane"
    return f"{found}; {apart} ({board.disagreement_sigmas:.1f} sigma); used: {board.used}"


EVERY = 3
"""Of 30 frames a second."""
GAUGE_WIDTH = 31


def watch(camera: Camera, stop: Callable[[], bool]) -> Glance | None:
    """Show what each third frame of an entered camera says, until it ends or `stop` says so; returns the last."""
    last: Glance | None = None
    with Live(console=stderr, auto_refresh=False, transient=True) as live:
        for number, frame in enumerate(camera):
            if number % EVERY == 0:
                last = glance(frame)
                live.update(panel(last), refresh=True)
            if stop():
                break
    return last


def until_enter() -> Callable[[], bool]:
    """Whether somebody has pressed Enter since; the end of the input counts as that."""
    pressed = Event()

    def wait() -> None:
        sys.stdin.readline()
        pressed.set()

    Thread(target=wait, name="waits for Enter", daemon=True).start()
    return pressed.is_set


def watch_until_enter(camera: Camera) -> None:
    """Show the wall until Enter is pressed."""
    say("position the lidar; [bold]Enter[/] measures, Ctrl-C leaves", marked=True)
    with camera as source:
        last = watch(source, until_enter())
    if last is not None:
        stderr.print(panel(last))


def panel(seen: Glance) -> Table:
    """A glance as a few lines with gauges over the paper's ranges."""
    table = Table.grid(padding=(0, 2))
    if seen.fit is None:
        table.add_row("wall", f"[yellow]not measured:[/] {escape(seen.refused)}")
    else:
        fit = seen.fit
        table.add_row("distance", f"{fit.distance_m:.4f} m", gauge(fit.distance_m, *DISTANCE_RANGE_M))
        table.add_row("facing", f"{fit.facing_deg:.2f} deg", gauge(fit.facing_deg, *FACING_RANGE_DEG))
        table.add_row("yaw, pitch", f"{fit.yaw_deg:+z.2f}, {fit.pitch_deg:+z.2f} deg")
        colour = "green" if fit.verdict == "good" else "yellow"
        table.add_row("verdict", f"[{colour}]{fit.verdict}[/]", fit.advice)
    if seen.saturated > MAX_SATURATED:
        table.add_row("infrared", f"{seen.saturated:.1%} saturated", "lower the laser's power, or move back")
    return table


def gauge(value: float, low: float, high: float) -> str:
    """Where a value lies on the way from `low` to `high`; at an end, with an arrow, where it is beyond."""
    share = (value - low) / (high - low)
    place = round(min(max(share, 0.0), 1.0) * (GAUGE_WIDTH - 1))
    mark = "◀" if share < 0 else "▶" if share > 1 else "●"
    return f"{low:g} {'─' * place}{mark}{'─' * (GAUGE_WIDTH - 1 - place)} {high:g}"


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
    """Add the commands."""
    app.command()(calibrate)
    app.command()(board)


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


def _look(uri: str, frames: int) -> CaptureStatistics:
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
    seen: CaptureStatistics, fit: WallFit | WallByBoard, facts: dict[str, object], occluder: OccluderRecord | None
) -> WallRecord:
    """The record of a wall that was measured now."""
    return new_wall_record(
        fit,
        seen.intrinsics,
        camera=seen.camera,
        frames=seen.statistics.depth.frames,
        created=datetime.now().astimezone().date(),
        occluder=occluder,
        others={**seen.facts(), **facts},
    )


SheetOut = Annotated[Path | None, typer.Option("--out", help="The PDF to write.")]
OnSheet = Annotated[Paper, typer.Option("--paper", help="What it will be printed on.")]


def board(out: SheetOut = None, paper: OnSheet = "a4", overwrite: Overwrite = False, json: Json = False) -> None:
    """Write a ChArUco board as a PDF to scale, to be glued to the wall for `nlos-cam calibrate --wall --board`."""
    path = output_path(out, "board", ".pdf", overwrite=overwrite)
    write_sheet(path, paper)
    printed = BOARDS[paper]
    squares = f"{printed.squares_x} x {printed.squares_y} squares of {printed.square_mm:g} mm"
    text = (
        f"{squares} on {paper}\n"
        "print at 100 % with a laser printer (dye ink is white in infrared), and measure the bar: 100 mm\n"
        f"wrote {path}"
    )
    result = {"out": str(path), "paper": paper, "page_mm": list(PAPER_MM[paper]), **printed.model_dump()}
    finish(result, as_json=json, text=text)
