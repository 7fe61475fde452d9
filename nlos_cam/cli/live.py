"""`nlos-cam live` and `nlos-cam replay`: frames in, hidden depth out."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.errors import RecordFileError
from nlos_calibration.rig import Rig, load_rig
from nlos_calibration.rig_difference import rig_difference
from nlos_models.checkpoint import CheckpointRecord
from nlos_models.inference import load_reconstructor
from rich.markup import escape

from nlos_cam.bench import Bench, open_bench
from nlos_cam.cache import cache_folder
from nlos_cam.camera import Recording, open_camera
from nlos_cam.camera.clock import WallClock
from nlos_cam.camera.table import Reader
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
from nlos_cam.cli.view import SaveReplayView, SaveView, Stills, Video, saved_as, saving
from nlos_cam.live import run_live, warm_up
from nlos_cam.live_report import LiveReport
from nlos_cam.processing import Processing
from nlos_cam.replay import REPORT, replay
from nlos_cam.replay_looks import Looks
from nlos_cam.sightings import in_words
from nlos_cam.view.viewer import NullViewer, Viewer

CameraUri = Annotated[str, typer.Option("--camera", help="l515, l515:SERIAL, sim, sim:scene.toml, bag:run.bag.")]
Wall = Annotated[Path | None, typer.Option("--wall", help="The wall as `calibrate --wall` found it (wall.toml).")]
Weights = Annotated[Path | None, typer.Option("--weights", help="A folder of other weights than the shipped ones.")]
Seconds = Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after so long; else at Ctrl-C.")]
Average = Annotated[
    int,
    typer.Option("--average", min=1, max=1000, help="Average the maps of so many frames; what moves meanwhile smears."),
]
NoView = Annotated[bool, typer.Option("--no-view", help="Serve no live view.")]
RecordTo = Annotated[Path | None, typer.Option("--record", help="Also record the camera's streams (F.bag).")]
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
    record: RecordTo = None,
    weights: Weights = None,
    average: Average = 1,
    save_view: SaveView = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Show what is hidden around the corner, live, in a browser."""
    if record is not None and record.suffix != ".bag":
        raise typer.BadParameter(f"--record {record}: a recording's name ends in .bag")
    path = output_path(record, "live", ".bag", overwrite=overwrite) if record else None
    recording = Recording(path, optional=True) if path else None
    view_path = saved_as(save_view, overwrite=overwrite)
    with interrupted_by_signals():
        with tracked("rendering the scene ahead") as on_progress:
            opened = open_camera(camera, on_progress=on_progress, recording=recording)
        bench = open_bench(wall, opened)
        processing = _processing(bench, weights, average)
        warm_up(opened, processing)
    viewers = saving(_viewer(bench, no_view=no_view), bench, view_path)
    with stop_on_signals() as stop, viewers as viewer, opened as source:
        say(
            f"live view: {viewer.address}  (Ctrl-C ends it)"
            if viewer.address
            else "running without a view (Ctrl-C ends it)"
        )
        report = run_live(
            source,
            processing,
            viewer,
            stop=stop,
            seconds=seconds,
            recorded=camera.startswith("bag:"),
            clock=WallClock().now,
            on_error=lambda until_then: say(_told(until_then)),
            on_warning=_warn,
        )
    if recording:
        say(f"recorded {recording.sets} frames to {recording.path}")
    if view_path:
        say(f"saved the view: nlos-cam view {view_path}")
    finish(asdict(report), as_json=json, text=_told(report))
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
        processing = _processing(open_bench(wall, opened), weights, average)
    with opened as source, stop_on_signals() as stop, progress() as bar:
        task = bar.add_task("reconstructing", total=None)
        report = replay(
            source,
            processing,
            path,
            stop=stop,
            on_frame=lambda: bar.advance(task),
            on_warning=_warn,
            looks=Looks(processing.bench, view=save_view, stills=stills, video=video),
        )
    text = f"{report.frames} frames in {report.seconds:.1f} s: {path / REPORT}"
    finish(asdict(report), as_json=json, text=text)
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def _processing(bench: Bench, weights: Path | None, average: int) -> Processing:
    """What is made of frames; says what the networks are, and whether they were trained for this rig."""
    network, rig = load_reconstructor(weights, cache_folder() / "onnx"), bench.rig
    eats_difference = network.record.input == "difference maps"
    processing = Processing(bench, network, eats_difference=eats_difference, average=average)
    say(f"networks: {network.runtime}, trained for rig {network.record.rig_name}")
    for note in [*_rig_notes(network.record, rig), *_reference_note(bench)]:
        say(f"note: {note}")
    return processing


def _rig_notes(trained: CheckpointRecord, rig: Rig) -> list[str]:
    """How the bench differs from the one that the networks were trained for."""
    try:
        theirs = load_rig(trained.rig_name)
    except RecordFileError:  # trained for a rig of a file that is not here
        theirs = None
    if theirs is None or theirs.checksum != trained.rig_checksum:
        unlike = trained.rig_checksum != rig.checksum
        return [f"the networks were trained for another rig than {rig.name}: what they show is off"] if unlike else []
    difference = rig_difference(rig, theirs)
    return (
        [f"unlike the rig of the networks, this one has {'; '.join(difference)}: they err more"] if difference else []
    )


def _reference_note(bench: Bench) -> list[str]:
    if not bench.measured or bench.reference:
        return []
    told = "no difference maps are formed, and a lidar that moves is not noticed: calibrate the wall again"
    return [f"this wall's record has no reference: {told}"]


def _viewer(bench: Bench, *, no_view: bool) -> Viewer:
    if no_view:
        return NullViewer()
    from nlos_cam.view.rerun_viewer import RerunViewer

    return RerunViewer(bench.rig, bench.measured)


def _warn(warning: str, begins: bool) -> None:
    say(f"[yellow]warning:[/] {escape(warning)}" if begins else f"no longer: {escape(warning)}")


def _told(report: LiveReport) -> str:
    latency, stages = report.latency_ms, report.stages_ms
    told = ", ".join(f"{name} {value:.1f}" for name, value in stages.items())
    seen = in_words(report.counts)
    return (
        f"{report.frames} frames, {report.fps:.1f} per second, {report.dropped} dropped\n"
        f"latency  {latency['p50']:.0f} ms median, {latency['p95']:.0f} ms p95, {latency['p99']:.0f} ms p99\n"
        f"stages   {told} (median ms)"
        + (f"\nseen     {seen}" if seen else "")
        + "".join(f"\nwarning  {frames} frames: {escape(text)}" for text, frames in report.warnings.items())
    )
