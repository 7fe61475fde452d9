"""`nlos-cam calibrate` measures the bench before its use; `nlos-cam board` prints a board for
it.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import nlos_calibration as walls
import typer
from nlos_calibration.errors import CalibrationError, RecordFileError
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from nlos_cam import adapt as adaptation
from nlos_cam import bench as benches
from nlos_cam import calibrate as bench
from nlos_cam import camera as cameras
from nlos_cam import reconstruct
from nlos_cam.cli import benches as benching
from nlos_cam.cli.adapt import WORK
from nlos_cam.cli.common import (
    Camera,
    Json,
    Overwrite,
    ask,
    finish,
    interrupted_by_signals,
    output_path,
    progress,
    say,
    stderr,
    stop_on_signals,
    tracked,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Paper = Literal["a4", "a3", "letter"]
EVERY = 3
"""Frames between two updates of the display, of 30 a second."""
GAUGE_WIDTH = 31


def format_result(record: walls.WallRecord, files: bench.WallFiles) -> str:
    """Return quantities with 95 % intervals, the verdict, warnings and the files written, with
    Rich's markup.
    """
    rows = walls.wall_facts(record)
    name_width = max(len(name) for name, _, _ in rows)
    value_width = max(len(value) for _, value, _ in rows)
    lines = [
        f"{name:{name_width}}  {value:{value_width}}  [dim]{escape(meaning)}[/]"
        for name, value, meaning in rows
    ]
    advice = record.advice[:1].upper() + record.advice[1:]
    lines.append(f"[bold {_color(record.verdict)}]Verdict: {record.verdict}.[/] {escape(advice)}.")
    lines += [f"Note: {escape(warning)}" for warning in record.warnings]
    written = [str(files.record), files.report.name]
    if record.reference:
        written.insert(1, files.reference.name)
    report = escape(str(files.report))
    lines.append(f"Wrote {escape(', '.join(written))}: open {report} for the report")
    return "\n".join(lines)


def _color(verdict: str) -> str:
    return "green" if verdict == "good" else "yellow"


def watch_wall(camera: cameras.Camera, stop: Callable[[], bool]) -> bench.FrameFit | None:
    """Show the wall fitted to every third frame of an entered camera, until it ends or `stop`;
    return the last fit.
    """
    last: bench.FrameFit | None = None
    with Live(console=stderr, auto_refresh=False, transient=True) as live:
        for number, frame in enumerate(camera):
            if number % EVERY == 0:
                last = bench.fit_frame(frame)
                live.update(panel(last), refresh=True)
            if stop():
                break
    return last


def until_enter() -> Callable[[], bool]:
    """Return a function that is true once Enter was pressed or stdin ended; a daemon thread reads
    stdin.
    """
    pressed = Event()

    def wait() -> None:
        sys.stdin.readline()
        pressed.set()

    Thread(target=wait, name="wait for Enter", daemon=True).start()
    return pressed.is_set


def panel(found: bench.FrameFit) -> Table:
    """Return the fit of one frame as a few lines, with gauges over the paper's ranges."""
    from nlos_cam.frames import MAX_SATURATED

    table = Table.grid(padding=(0, 2))
    if found.fit is None:
        table.add_row("wall", f"[yellow]not measured:[/] {escape(found.refusal)}")
    else:
        fit = found.fit
        distance = gauge(fit.distance_m, *walls.DISTANCE_RANGE_M)
        facing = gauge(fit.facing_deg, *walls.FACING_RANGE_DEG)
        table.add_row("distance", f"{1e3 * fit.distance_m:.1f} mm", distance)
        table.add_row("facing", f"{fit.facing_deg:.2f}°", facing)
        table.add_row("yaw, pitch", f"{fit.yaw_deg:+z.2f}°, {fit.pitch_deg:+z.2f}°")
        table.add_row("verdict", f"[{_color(fit.verdict)}]{fit.verdict}[/]", fit.advice)
    if found.saturated > MAX_SATURATED:
        table.add_row(
            "infrared", f"{found.saturated:.1%} saturated", "lower the laser's power, or move back"
        )
    return table


def gauge(value: float, low: float, high: float) -> str:
    """Return a scale from `low` to `high` with a mark at the value; an arrow at the end where it is
    beyond.
    """
    share = (value - low) / (high - low)
    place = round(min(max(share, 0.0), 1.0) * (GAUGE_WIDTH - 1))
    mark = "●"
    if share < 0:
        mark = "◀"
    elif share > 1:
        mark = "▶"
    return f"{low:g} {'─' * place}{mark}{'─' * (GAUGE_WIDTH - 1 - place)} {high:g}"


Wall = Annotated[
    bool, typer.Option("--wall", help="Measure the bare wall: no object, no occluder.")
]
Bag = Annotated[
    Path | None,
    typer.Option(
        "--bag",
        help="Recording in place of CAMERA: of the bare wall, or of the occluder without object.",
    ),
]
BareRecord = Annotated[
    Path | None,
    typer.Option(
        "--occluder",
        help="Find the occluder in front of the wall of this record (wall.toml) or bench folder.",
    ),
]
Frames = Annotated[int, typer.Option("--frames", min=1, help="Number of frames to average.")]
Watch = Annotated[
    bool,
    typer.Option(
        "--watch", help="Show distance and angle live until Enter is pressed, then measure."
    ),
]
Tape = Annotated[
    float | None,
    typer.Option(
        "--tape-m",
        min=0.01,
        help="Distance measured by tape, in metres: front glass to wall, along its normal.",
    ),
]
ByBoard = Annotated[
    bool, typer.Option("--board", help="Also find a printed board (`nlos-cam board`).")
]
OnPaper = Annotated[
    Paper | None, typer.Option("--paper", help="Paper of the printed board (default: a4).")
]
SquareMm = Annotated[
    float | None,
    typer.Option(
        "--square-mm",
        min=1.0,
        max=1000.0,
        help="Measured side of the board's squares in mm: length of its bar x 0.3.",
    ),
]
OccluderX = Annotated[
    float | None,
    typer.Option(
        "--occluder-x-m",
        min=0.01,
        max=100.0,
        help="Occluder's edge measured by hand, in metres along the wall from the lidar's foot.",
    ),
]
OccluderGap = Annotated[
    float | None,
    typer.Option(
        "--occluder-gap-m",
        min=0.001,
        max=100.0,
        help="Gap between occluder's edge and wall measured by hand, in metres.",
    ),
]
Upright = Annotated[
    bool | None,
    typer.Option(
        "--upright/--upside-down",
        help="Which way up the camera is, where it has no accelerometer (default: asked once).",
    ),
]
Out = Annotated[Path | None, typer.Option("--out", help="Record to write (TOML).")]
BenchToWrite = Annotated[
    Path | None,
    typer.Option("--bench", help="Bench folder to write to, in place of --out; made if missing."),
]
JSON_FIELDS = {
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
    "gravity_m_s2",
    "way_up",
}
"""Fields of the record that --json prints."""


def calibrate(
    camera: Camera = "sim",
    wall: Wall = False,
    bag: Bag = None,
    occluder: BareRecord = None,
    frames: Frames = 60,
    watch: Watch = False,
    tape_m: Tape = None,
    board: ByBoard = False,
    paper: OnPaper = None,
    square_mm: SquareMm = None,
    occluder_x_m: OccluderX = None,
    occluder_gap_m: OccluderGap = None,
    upright: Upright = None,
    out: Out = None,
    bench_folder: BenchToWrite = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Measure the wall's distance and angle from frames of the bare wall, and write record,
    reference and report.

    Beside the record wall.toml it writes wall.npz, the bare wall's reference for difference maps,
    and wall.html, the report. Once the occluder stands, --occluder wall.toml finds it and takes a
    new reference, with no object hidden. With --bench bench/ all of them go into one folder, which
    other commands take as --bench; the occluder is then found with --occluder bench/.
    """
    uri = _source(camera, bag, wall=wall, occluder=occluder, watch=watch)
    by_hand = _entered(occluder_x_m, occluder_gap_m)
    measured = board or tape_m is not None or by_hand or upright is not None
    _refuse_board_options(board=board, paper=paper, square_mm=square_mm, tape_m=tape_m)
    _refuse_occluder_options(occluder, out, measured=bool(measured), watch=watch)
    target = Target.of(bench_folder, occluder, out, overwrite=overwrite)
    if watch:
        ask("Position the lidar. [bold]Enter[/] measures, Ctrl-C cancels.", marked=True)
        with _opened(uri) as source:
            last = watch_wall(source, until_enter())
        if last is not None:
            stderr.print(panel(last))
    capture = _capture(uri, frames)
    inliers: NDArray[np.bool_] | None
    if target.bare:
        record, inliers = bench.measure_occluder(capture, target.bare)
    else:
        way_up = _way_up(capture, upright)
        if board:
            fit, facts = bench.measure_by_board(capture, walls.BOARDS[paper or "a4"], square_mm)
        else:
            fit, facts = bench.measure_by_depth(capture, tape_m)
        record = capture.record(fit, facts | {"way_up": way_up}, by_hand)
        inliers = fit.inliers if isinstance(fit, walls.WallFit) else None
    record = target.write(record, None if inliers is None else capture.reference(inliers))
    written = f"{target.files.record} is written"
    if target.folder:
        written += "; `nlos-cam predict` makes the forecast of the bench"
    with interrupted_by_signals(written):
        _report(target, record, as_json=json)


def _report(target: Target, record: walls.WallRecord, *, as_json: bool) -> None:
    """Forecast what a bench that was written can show, and print the measurement, whether the
    weights serve it, and the next step.
    """
    fields = record.model_dump(mode="json", include=JSON_FIELDS)
    files = target.files
    result = fields | {"out": str(files.record), "report": str(files.report)}
    if target.folder:
        benching.store_forecast(target.folder)
    loaded = _written_bench(target.folder) if target.folder else None
    rig = loaded.rig if loaded else record.beam_rig
    own = loaded.weights if loaded else None
    served = benches.weights_verdict(rig, own or reconstruct.weights_for(rig), loaded, files.record)
    result["weights"] = {
        "serve": served.serve,
        "verdict": served.sentence,
        "expected_iou": served.expected_iou,
    }
    text = format_result(record, files)
    text += f"\n{escape(served.sentence[:1].upper() + served.sentence[1:])}"
    if target.folder:
        result["bench"] = str(target.folder)
        text += f"\nNext: {escape(_next_step(target.folder, record, served))}"
    finish(result, as_json=as_json, text=text, marked=True)


def _refuse_board_options(
    *, board: bool, paper: str | None, square_mm: float | None, tape_m: float | None
) -> None:
    if not board and (paper or square_mm):
        raise typer.BadParameter("--paper and --square-mm need --board")
    if board and tape_m is not None:
        raise typer.BadParameter(
            "give one of --tape-m and --board: each measures the lidar's range offset"
        )


def _refuse_occluder_options(
    occluder: Path | None, out: Path | None, *, measured: bool, watch: bool
) -> None:
    """Raise typer.BadParameter for options of the bare wall, `measured` by them, beside
    --occluder.
    """
    if occluder is None:
        return
    if measured:
        raise typer.BadParameter(
            "--occluder uses a wall that was measured before: drop --board, --tape-m, --upright,"
            " --occluder-x-m, -gap-m"
        )
    if watch:
        raise typer.BadParameter(
            "--watch shows the bare wall: position the lidar with it first, then add the occluder"
        )
    if out and out.resolve() == occluder.resolve():
        raise typer.BadParameter(
            f"--out {out} is the record of the bare wall, which stays: choose another name"
        )


class Target(NamedTuple):
    """Bare wall to start from, and what to write: a record of its own, or into a bench folder."""

    folder: Path | None
    """Bench folder; None for a record of its own."""
    bare: walls.MeasuredWall | None
    """Measured bare wall in front of which the occluder is found; None to measure the wall."""
    files: bench.WallFiles
    overwrite: bool

    @classmethod
    def of(
        cls, folder: Path | None, occluder: Path | None, out: Path | None, *, overwrite: bool
    ) -> Target:
        """Return the target of the options, before anything is measured."""
        folder = _bench_folder(folder, occluder, out)
        bare = _bare_wall(occluder) if occluder else None
        if folder:
            benches.check_new(folder)
            files = benching.files_in_bench(folder, occluder=bool(bare), overwrite=overwrite)
        else:
            if out is not None and out.suffix != ".toml":
                raise typer.BadParameter(f"--out {out}: choose a name that ends in .toml")
            path = output_path(out, "wall", ".toml", overwrite=overwrite)
            files = bench.WallFiles.beside(path, overwrite=overwrite)
        return cls(folder, bare, files, overwrite)

    def write(self, record: walls.WallRecord, reference: walls.BareWall | None) -> walls.WallRecord:
        """Write the measurement, and return the record, which names its reference. An interruption
        waits for the end: half of the files would fit no record.
        """
        with stop_on_signals() as stop:
            if self.folder:
                record = benching.write_to_bench(
                    self.folder, self.files, record, reference, overwrite=self.overwrite
                )
            else:
                record = bench.write_record(self.files, record, reference)
        if stop.is_set():
            raise KeyboardInterrupt(f"{self.files.record} is written")
        return record


def _bench_folder(folder: Path | None, occluder: Path | None, out: Path | None) -> Path | None:
    """Return the bench folder to write to: --bench, or the one that --occluder names; None for a
    record of its own.
    """
    if occluder and occluder.is_dir():
        if folder and folder.resolve() != occluder.resolve():
            raise typer.BadParameter(
                f"--occluder {occluder} and --bench {folder} are two benches: name one"
            )
        folder = occluder
    elif occluder and folder:
        raise typer.BadParameter(
            f"--occluder {occluder} is a record of its own: give --occluder {folder}, the bench"
            " whose bare wall was measured"
        )
    if folder and out:
        raise typer.BadParameter("--bench and --out each name what to write: give one")
    return folder


def _written_bench(folder: Path) -> benches.Bench:
    """Return the bench that was just written, without its weights where they are lost or damaged:
    those stop no calibration. Raises RecordFileError.
    """
    try:
        return benches.load_bench(folder)
    except RecordFileError as error:
        found = benches.load_bench(folder, weights=False)
        say(f"note: {error}")
        return found


def _bare_wall(source: Path) -> walls.MeasuredWall:
    """Return the bare wall of a record, or of a bench folder. Raises RecordFileError."""
    return benches.load_bare_wall(source) if source.is_dir() else walls.load_measured(source)


def _next_step(folder: Path, record: walls.WallRecord, served: reconstruct.WeightsVerdict) -> str:
    """Return the command to go on with; weights of its own come before live pictures where the
    bench needs them.
    """
    name = shlex.quote(str(folder))
    source = cameras.source_to_name(record)
    pictures = cameras.pictures_command(record, f"--bench {name}")
    if record.verdict == "doubtful":
        return "mend what makes the record doubtful, and measure again"
    if record.occluder is None:
        step = f"put the occluder up, then nlos-cam calibrate --occluder {name} {source}"
        if record.verdict == "out of range":
            step = f"correct it, and give the same command with --overwrite; or {step}"
        return step
    # An adaptation from before is to the rig that was just replaced.
    again = " --overwrite" if (folder / WORK / adaptation.PLAN).exists() else ""
    if served.serve or not served.adapting_helps:
        return pictures
    return f"nlos-cam adapt {name} --minutes 10{again}, then {pictures}"


def _source(
    camera: str | None, bag: Path | None, *, wall: bool, occluder: Path | None, watch: bool
) -> str:
    """Return the URI to read from. Raises typer.BadParameter for arguments that are missing or
    contradict.
    """
    if wall == (occluder is not None):
        raise typer.BadParameter(
            "choose what to measure: --wall, or --occluder wall.toml once the wall is measured"
        )
    is_recording = bag is not None or cameras.full_uri(camera or "").startswith("bag:")
    if is_recording and watch:
        raise typer.BadParameter(
            "--watch is for a lidar that can still be moved, not for a recording: drop it"
        )
    if bag is not None and camera is None:
        return f"bag:{bag}"
    if camera is not None and bag is None:
        return camera
    raise typer.BadParameter("give one of CAMERA and --bag F.bag")


def _entered(x_m: float | None, gap_m: float | None) -> walls.OccluderRecord | None:
    """Return the occluder measured by hand. Raises typer.BadParameter for one of its two
    numbers.
    """
    if x_m is None and gap_m is None:
        return None
    if x_m is None or gap_m is None:
        raise typer.BadParameter("--occluder-x-m and --occluder-gap-m must be given together")
    return walls.OccluderRecord(source="entered", x_m=x_m, gap_m=gap_m)


def _opened(uri: str) -> cameras.Camera:
    with tracked("Opening the camera") as on_progress:
        return cameras.open_camera(uri, on_progress=on_progress)


def _capture(uri: str, frames: int) -> bench.CaptureStatistics:
    with _opened(uri) as source, progress() as bar:
        task = bar.add_task("Measuring the wall", total=frames)
        return bench.collect_statistics(source, frames, lambda: bar.advance(task))


def _way_up(capture: bench.CaptureStatistics, upright: bool | None) -> walls.WayUp:
    """Return the way up of a camera; a person at a terminal is asked where it has no accelerometer.

    Raises CalibrationError as `check_way_up`.
    """
    said: walls.WayUp = "unknown"
    if upright is not None:
        said = "upright" if upright else "upside down"
    elif capture.gravity_m_s2 is None and sys.stdin.isatty():
        question = "Is the camera upright, with the thread of its screw down?"
        if not typer.confirm(question, default=True, err=True):
            raise CalibrationError(f"the camera is upside down, {bench.TURN_IT}")
        said = "upright"
    return bench.check_way_up(capture.gravity_m_s2, said)


SheetOut = Annotated[Path | None, typer.Option("--out", help="PDF to write.")]
OnSheet = Annotated[Paper, typer.Option("--paper", help="Paper size.")]


def board(
    out: SheetOut = None, paper: OnSheet = "a4", overwrite: Overwrite = False, json: Json = False
) -> None:
    """Write a ChArUco board as a PDF to scale, to be glued to the wall for `nlos-cam calibrate
    --wall --board`.
    """
    if out is not None and out.suffix != ".pdf":
        raise typer.BadParameter(f"--out {out}: choose a name that ends in .pdf")
    path = output_path(out, "board", ".pdf", overwrite=overwrite)
    bench.write_board_pdf(path, paper)
    printed = walls.BOARDS[paper]
    text = (
        f"{printed.squares_x} x {printed.squares_y} squares of {printed.square_mm:g} mm on"
        f" {paper}\nPrint at 100 % with a laser printer (dye ink is white in infrared), and check"
        f" that the bar measures 100 mm.\nWrote {path}"
    )
    result = {
        "out": str(path),
        "paper": paper,
        "page_mm": list(walls.PAPER_MM[paper]),
        **printed.model_dump(),
    }
    finish(result, as_json=json, text=text)
