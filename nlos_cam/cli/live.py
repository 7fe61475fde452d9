"""`nlos-cam live` and `nlos-cam replay`: frames in, hidden depth out.

What `nlos-cam live` tells a person: warnings as they come, and a report at the end.

What `nlos-cam live` leaves behind, where it is asked to: a recording, a log of its frames, a saved view.

`nlos-cam live --budget-ms`: the setting that keeps a delay on this machine, found by measuring, and told.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from nlos_models import Reconstructor, UncertaintyModel
from rich.markup import escape

from nlos_cam.camera import Camera, Reader, Recording, WallClock, open_camera
from nlos_cam.cli.common import (
    INTERRUPTED,
    Json,
    Overwrite,
    finish,
    interrupted_by_signals,
    output_path,
    progress,
    say,
    stop_on_signals,
    tracked,
)
from nlos_cam.cli.view import (
    SUFFIX,
    NoView,
    Open,
    SaveReplayView,
    SaveView,
    Stills,
    Video,
    ViewHost,
    ViewPort,
    saving,
    tell_of_view,
    viewer_of,
)
from nlos_cam.evaluate import runtimes
from nlos_cam.live import (
    OUTSIDE_LATENCY,
    REPORT,
    SHIPPED,
    SUFFIXES,
    BackgroundPhysicsCheck,
    BudgetChoice,
    FrameLog,
    Looks,
    RunReport,
    available_options,
    choose_within_budget,
    describe_counts,
    loader,
    low_latency_interpreter,
    realtime_priority,
    replay_recording,
    run_live,
    timer,
    warm_up,
)
from nlos_cam.reconstruct import (
    CalibratedRig,
    PhysicsCheck,
    Pipeline,
    build_pipeline,
    compatibility_warnings,
    load_networks,
    load_uncertainty,
    open_bench,
)
from nlos_cam.view import Moment


def warn(warning: str, begins: bool) -> None:
    """Tell that a warning begins, or ends."""
    say(f"[yellow]warning:[/] {escape(warning)}" if begins else f"no longer: {escape(warning)}", marked=True)


def told(report: RunReport) -> str:
    """The report in a few lines."""
    latency = report.latency_ms
    lines = [
        f"{report.frames} frames, {report.fps:.1f} per second, {report.dropped} dropped",
        f"latency  {latency['p50']:.0f} ms median, {latency['p95']:.0f} ms p95, {latency['p99']:.0f} ms p99",
        f"stages   {_stages(report)} (median and p99 in ms)",
    ]
    if report.verdicts:
        lines.append(f"verdicts {', '.join(f'{count} {verdict}' for verdict, count in report.verdicts.items())}")
    if seen := describe_counts(report.counts):
        lines.append(f"seen     {seen}")
    if report.stalled_s:
        lines.append(f"stalled  {report.stalled_s:.1f} s without a frame")
    lines += [f"warning  {frames} frames: {text}" for text, frames in report.warnings.items()]
    return "\n".join(lines)


def _stages(report: RunReport) -> str:
    """Those that make up the latency first, and then the others."""
    stages = report.stages_percentiles_ms
    ordered = sorted(stages, key=lambda name: name in OUTSIDE_LATENCY)
    return ", ".join(f"{name} {stages[name]['p50']:.1f} {stages[name]['p99']:.1f}" for name in ordered)


RecordTo = Annotated[Path | None, typer.Option("--record", help="Also record the camera's streams (F.bag).")]
Log = Annotated[Path | None, typer.Option("--log", help="Write one line for each frame: F.csv, or F.jsonl.")]


@dataclass(frozen=True)
class Kept:
    """What a live run leaves behind, where it was asked to."""

    recording: Recording | None
    log: Path | None
    view: Path | None

    def say(self) -> None:
        """Where it is, once it is written."""
        if self.recording:
            say(f"recorded {self.recording.sets} frames to {self.recording.path}")
        if self.view:
            say(f"saved the view: nlos-cam view {self.view}")

    @contextmanager
    def logging(self) -> Generator[Callable[[Moment], None]]:
        """What is called with each frame's moment: a log's `add`, if there is a path to write it to."""
        if self.log is None:
            yield lambda _: None
            return
        with FrameLog(self.log) as frame_log:
            yield frame_log.add
        say(f"logged each frame to {self.log}")


def kept_of(record: Path | None, log: Path | None, save_view: Path | None, *, overwrite: bool) -> Kept:
    """Raises typer.BadParameter for a name that is not of its kind, or that is taken."""
    path = _named(record, "--record", "a recording", (".bag",), overwrite=overwrite)
    frame_log = _named(log, "--log", "a log", SUFFIXES, overwrite=overwrite)
    view = _named(save_view, "--save-view", "a saved view", (SUFFIX,), overwrite=overwrite)
    return Kept(Recording(path, optional=True) if path else None, frame_log, view)


def _named(path: Path | None, option: str, what: str, suffixes: tuple[str, ...], *, overwrite: bool) -> Path | None:
    """Where something is written, if it is. Raises typer.BadParameter for a name that is not of its kind."""
    if path is None:
        return None
    if path.suffix not in suffixes:
        raise typer.BadParameter(f"{option} {path}: {what}'s name ends in {' or '.join(suffixes)}")
    return output_path(path, "live", path.suffix, overwrite=overwrite)


BudgetMs = Annotated[
    float | None,
    typer.Option("--budget-ms", min=0.1, help="Choose the most accurate setting whose delay stays below so much."),
]
Tradeoff = Annotated[
    Path | None,
    typer.Option("--tradeoff", help="What `tradeoff reconstruct` measured, for --budget-ms; else beside the weights."),
]


CameraUri = Annotated[str, typer.Option("--camera", help="l515, l515:SERIAL, sim, sim:scene.toml, bag:run.bag.")]
Wall = Annotated[Path | None, typer.Option("--wall", help="The wall as `calibrate --wall` found it (wall.toml).")]
Weights = Annotated[Path | None, typer.Option("--weights", help="A folder of other weights than the shipped ones.")]
Seconds = Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after so long; else at Ctrl-C.")]
Average = Annotated[
    int,
    typer.Option("--average", min=1, max=1000, help="Average the maps of so many frames; what moves meanwhile smears."),
]
ReadBy = Annotated[Reader, typer.Option("--reader", help="Who reads the file: plain (we), or sdk (librealsense).")]
BagFile = Annotated[Path, typer.Argument(metavar="F.BAG", help="A recording with depth, infrared and confidence.")]
Out = Annotated[Path | None, typer.Option("--out", help="The folder to write.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("live")(live)
    app.command("replay")(replay_bag)


def live(
    camera: CameraUri,
    wall: Wall = None,
    seconds: Seconds = None,
    no_view: NoView = False,
    view_port: ViewPort = None,
    view_host: ViewHost = None,
    open_view: Open = False,
    record: RecordTo = None,
    log: Log = None,
    weights: Weights = None,
    average: Average = 1,
    budget_ms: BudgetMs = None,
    tradeoff: Tradeoff = None,
    save_view: SaveView = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Show what is hidden around the corner, live, in a browser."""
    if budget_ms is not None and average > 1:
        raise typer.BadParameter("--budget-ms chooses how many frames are averaged: leave --average away")
    kept = kept_of(record, log, save_view, overwrite=overwrite)
    with interrupted_by_signals():
        with tracked("rendering the scene ahead") as on_progress:
            opened = open_camera(camera, on_progress=on_progress, recording=kept.recording)
        bench = open_bench(wall, opened)
        checks = BackgroundPhysicsCheck(bench.rig, on_error=_warn_once)
        processing, choice = _chosen(opened, bench, weights, average, budget_ms, tradeoff, checks)
        warm_up(opened, processing)
    viewer = saving(viewer_of(bench, no_view=no_view, host=view_host, port=view_port), bench, kept.view)
    with (
        stop_on_signals() as stop,
        realtime_priority(),
        viewer,
        kept.logging() as on_moment,
        low_latency_interpreter(),
        opened as source,
    ):
        tell_of_view(viewer, host=view_host, port=view_port, open_it=open_view)
        report = run_live(
            source,
            processing,
            viewer,
            stop=stop,
            seconds=seconds,
            recorded=camera.startswith("bag:"),
            clock=WallClock().now,
            on_error=lambda until_then: say(told(until_then)),
            on_warning=warn,
            on_moment=on_moment,
        )
    kept.say()
    _finish_live(report, choice, as_json=json)
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def replay_bag(
    bag: BagFile,
    wall: Wall = None,
    out: Out = None,
    weights: Weights = None,
    average: Average = 1,
    reader: ReadBy = "plain",
    save_view: SaveReplayView = False,
    stills: Stills = 0,
    video: Video = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Reconstruct every frame of a recording: the same frames and the same bits each time."""
    path = output_path(out, "replay", "", overwrite=overwrite)
    with interrupted_by_signals():
        opened = open_camera(f"bag:{bag}", reader=reader)
        bench = open_bench(wall, opened)
        from nlos_cam.reconstruct import PeriodicPhysicsCheck  # the renderer takes a second to import

        checks = PeriodicPhysicsCheck(bench.rig, on_error=_warn_once)
        processing = _processing(bench, load_networks(weights), load_uncertainty(weights), average, checks)
    with opened as source, stop_on_signals() as stop, progress() as bar:
        task = bar.add_task("reconstructing", total=None)
        report = replay_recording(
            source,
            processing,
            path,
            stop=stop,
            on_frame=lambda: bar.advance(task),
            on_warning=warn,
            looks=Looks(processing.bench, view=save_view, stills=stills, video=video),
        )
    text = f"{report.frames} frames in {report.seconds:.1f} s: {path / REPORT}"
    finish(asdict(report), as_json=json, text=text)
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def _finish_live(report: RunReport, choice: BudgetChoice | None, *, as_json: bool) -> None:
    """What the run did, and what became of its budget."""
    budget = {"budget": choice.outcome(report)} if choice else {}
    text = [told(report), *([choice.outcome_told(report)] if choice else [])]
    finish({**asdict(report), **budget}, as_json=as_json, text="\n".join(text))


def _chosen(
    camera: Camera,
    bench: CalibratedRig,
    weights: Path | None,
    average: int,
    budget_ms: float | None,
    tradeoff: Path | None,
    checks: PhysicsCheck,
) -> tuple[Pipeline, BudgetChoice | None]:
    """What is made of frames: as is usual, or within a budget, which then was chosen so."""
    if budget_ms is None:
        return _processing(bench, load_networks(weights), load_uncertainty(weights), average, checks), None
    options = available_options(tradeoff, weights)
    doubter = load_uncertainty(weights)
    making = partial(build_pipeline, bench, uncertainty_model=doubter)  # takes as long whatever it watches
    network, choice = choose_within_budget(budget_ms, options, making, loader(weights, runtimes), timer(camera))
    say(choice.told())
    if choice.option.weights != SHIPPED:
        doubter = load_uncertainty(Path(choice.option.weights))
    return _processing(bench, network, doubter, choice.option.frames, checks), choice


def _warn_once(warning: str) -> None:
    warn(warning, begins=True)


def _processing(
    bench: CalibratedRig, network: Reconstructor, doubter: UncertaintyModel | None, average: int, checks: PhysicsCheck
) -> Pipeline:
    """What is made of frames; says what the networks are, and whether they were trained for this rig."""
    processing = build_pipeline(bench, network, average, uncertainty_model=doubter, checks=checks)
    say(f"networks: {network.runtime}, trained for rig {network.record.rig_name}")
    for note in compatibility_warnings(bench, network.record, doubter):
        say(f"note: {note}")
    return processing
