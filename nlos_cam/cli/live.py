"""`nlos-cam live` and `nlos-cam replay`: frames in, hidden depth out."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from nlos_models.doubt_inference import Doubter
from nlos_models.inference import Reconstructor

from nlos_cam.camera import Camera, open_camera
from nlos_cam.camera.protocol import WallClock
from nlos_cam.camera.registry import Reader
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
from nlos_cam.cli.live_budget import BudgetMs, Tradeoff
from nlos_cam.cli.live_kept import Log, RecordTo, kept_of
from nlos_cam.cli.live_told import told, warn
from nlos_cam.cli.live_view import NoView, Open, ViewHost, ViewPort, tell_of_view, viewer_of
from nlos_cam.cli.view import SaveReplayView, SaveView, Stills, Video, saving
from nlos_cam.live.budget import SHIPPED, Choice, loader, options_here, timer, within_budget
from nlos_cam.live.loop import run_live, warm_up
from nlos_cam.live.physics_check_process import BackgroundChecks
from nlos_cam.live.realtime import precedence, undisturbed
from nlos_cam.live.replay import REPORT, replay
from nlos_cam.live.replay_media import Looks
from nlos_cam.live.statistics import LiveReport
from nlos_cam.reconstruct.bench import Bench, open_bench
from nlos_cam.reconstruct.physics_check import Checks
from nlos_cam.reconstruct.pipeline import Processing, load_doubt, load_networks, misfits, set_up

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
        checks = BackgroundChecks(bench.rig, on_error=_warn_once)
        processing, choice = _chosen(opened, bench, weights, average, budget_ms, tradeoff, checks)
        warm_up(opened, processing)
    viewer = saving(viewer_of(bench, no_view=no_view, host=view_host, port=view_port), bench, kept.view)
    with (
        stop_on_signals() as stop,
        precedence(),
        viewer,
        kept.logging() as on_moment,
        undisturbed(),
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
        from nlos_cam.reconstruct.physics_check import EveryFrames  # the renderer takes a second to import

        checks = EveryFrames(bench.rig, on_error=_warn_once)
        processing = _processing(bench, load_networks(weights), load_doubt(weights), average, checks)
    with opened as source, stop_on_signals() as stop, progress() as bar:
        task = bar.add_task("reconstructing", total=None)
        report = replay(
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


def _finish_live(report: LiveReport, choice: Choice | None, *, as_json: bool) -> None:
    """What the run did, and what became of its budget."""
    budget = {"budget": choice.outcome(report)} if choice else {}
    text = [told(report), *([choice.outcome_told(report)] if choice else [])]
    finish({**asdict(report), **budget}, as_json=as_json, text="\n".join(text))


def _chosen(
    camera: Camera,
    bench: Bench,
    weights: Path | None,
    average: int,
    budget_ms: float | None,
    tradeoff: Path | None,
    checks: Checks,
) -> tuple[Processing, Choice | None]:
    """What is made of frames: as is usual, or within a budget, which then was chosen so."""
    if budget_ms is None:
        return _processing(bench, load_networks(weights), load_doubt(weights), average, checks), None
    options = options_here(tradeoff, weights)
    doubter = load_doubt(weights)
    making = partial(set_up, bench, doubter=doubter)  # takes as long whatever it watches
    network, choice = within_budget(budget_ms, options, making, loader(weights), timer(camera))
    say(choice.told())
    if choice.option.weights != SHIPPED:
        doubter = load_doubt(Path(choice.option.weights))
    return _processing(bench, network, doubter, choice.option.frames, checks), choice


def _warn_once(warning: str) -> None:
    warn(warning, begins=True)


def _processing(
    bench: Bench, network: Reconstructor, doubter: Doubter | None, average: int, checks: Checks
) -> Processing:
    """What is made of frames; says what the networks are, and whether they were trained for this rig."""
    processing = set_up(bench, network, average, doubter=doubter, checks=checks)
    say(f"networks: {network.runtime}, trained for rig {network.record.rig_name}")
    for note in misfits(bench, network.record, doubter):
        say(f"note: {note}")
    return processing
