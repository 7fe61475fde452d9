"""`nlos-cam live`, `demo` and `replay`: options, messages and the report at the end."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from nlos_cam import camera as cameras
from nlos_cam import live as loop
from nlos_cam import reconstruct
from nlos_cam import recording as recordings
from nlos_cam import replay as replays
from nlos_cam import view as views
from nlos_cam.cli import benches, common
from nlos_cam.cli import view as viewing
from nlos_cam.cli.recordings import AsObject, object_formats

LOSSES = {
    "dropped_camera": "at the camera",
    "dropped_loop": "because processing was too slow",
    "incomplete": "with a stream missing",
    "failed": "whose processing failed",
}
"""Reason of a lost frame in words, by its name in RunReport.counts."""
EXPLANATION = (
    "A simulated lidar looks at a wall, and an airplane flies around the corner, out of its sight."
    " Of the light that bounces wall, airplane, wall, a network reconstructs it 30 times per"
    " second."
)
SLOW_DROPPED_SHARE = 0.05
SLOW_MS = 200.0
"""Share of dropped frames and median latency above which the summary warns."""

RecordTo = Annotated[
    Path | None, typer.Option("--record", help="Also record the camera's streams (F.bag).")
]
Log = Annotated[
    Path | None, typer.Option("--log", help="Write one line per frame: F.csv, or F.jsonl.")
]
Wall = Annotated[
    Path | None, typer.Option("--wall", help="Wall record of `calibrate --wall` (wall.toml).")
]
Average = Annotated[
    int,
    typer.Option(
        "--average", min=1, max=1000, help="Number of frames to average; moving objects blur."
    ),
]
PriorityOption = Annotated[
    loop.Priority,
    typer.Option(
        "--priority",
        help="Real-time priority where the system allows it (auto), or never; --verbose says which.",
    ),
]
BagFile = Annotated[
    Path, typer.Argument(metavar="F.BAG", help="Recording with depth, infrared and confidence.")
]
Out = Annotated[
    Path | None, typer.Option("--out", help="Directory to write (default: a dated one).")
]
Every = Annotated[
    int | None,
    typer.Option("--every", min=1, help="With --object, only every Nth frame (default: 1)."),
]


def demo(
    seconds: viewing.Seconds = None,
    no_view: viewing.NoView = False,
    view_port: viewing.ViewPort = None,
    open_view: viewing.Open = False,
    json: common.Json = False,
) -> None:
    """Show the live view of a simulated bench; no camera is needed. The same as `live sim`."""
    common.say(EXPLANATION)
    live(
        "sim", seconds=seconds, no_view=no_view, view_port=view_port, open_view=open_view, json=json
    )


def live(
    camera: common.Camera = "sim",
    wall: Wall = None,
    bench_folder: benches.BenchOrWeights = None,
    seconds: viewing.Seconds = None,
    no_view: viewing.NoView = False,
    view_port: viewing.ViewPort = None,
    view_host: viewing.ViewHost = None,
    open_view: viewing.Open = False,
    record: RecordTo = None,
    log: Log = None,
    weights: benches.Weights = None,
    average: Average = 1,
    save_view: viewing.SaveView = None,
    priority: PriorityOption = "auto",
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Show what is hidden around the corner, live, in a browser."""
    if no_view and open_view:
        raise typer.BadParameter("--open needs a view: drop --no-view")
    chosen = benches.choose(bench_folder, wall, weights)
    check_output = partial(_check_output, overwrite=overwrite)
    recording = None
    if record:
        path = check_output(record, "--record", ".bag")
        sidecar = recordings.sidecar_path(path)
        common.output_path(sidecar, "", sidecar.suffix, overwrite=overwrite)
        recording = cameras.Recording(path, optional=True, overwrite=overwrite)
    frame_log = loop.FrameLog(check_output(log, "--log", *loop.LOG_SUFFIXES)) if log else None
    view_file = check_output(save_view, "--save-view", views.SESSION_SUFFIX) if save_view else None
    clock = cameras.WallClock().now  # the system's may jump
    control = loop.RunControl(camera, clock=clock, wall=chosen.recorded_wall)
    viewer = viewing.viewer_of(control, no_view=no_view, host=view_host, port=view_port)
    announce = cache(
        partial(viewing.announce_view, viewer, host=view_host, port=view_port, open_it=open_view)
    )
    with viewer:  # serves before the camera runs
        with common.interrupted_by_signals():
            opened = _open_camera(camera, recording, control, announce)
            announce()
            bench = chosen.open(opened)
            checks = loop.BackgroundPhysicsCheck(bench.rig, on_error=_warn_once)
            control.set_state("connecting", "loading the networks, first frame in a few seconds")
            pipeline = _load_pipeline(bench, chosen, average, checks)
            reconstruct.warm_up(opened, pipeline)
            if not no_view:
                views.prepare_saving()
        viewer.begin(bench.rig, bench.measured)
        control.bench.on_bench = lambda bench: viewer.begin(bench.rig, bench.measured)
        if view_file:
            control.bench.is_saving = lambda: True
        with (
            common.stop_on_signals(hurry=control.hurry) as stop,
            loop.RealtimePriority(priority, control.strain_of(stop)),
            viewing.saving(viewer, bench, view_file) as viewers,
            frame_log or nullcontext(),
            loop.low_latency_interpreter(),
            opened as source,
        ):
            report = loop.run_live(
                source,
                pipeline,
                viewers,
                stop=stop,
                seconds=seconds,
                recorded=camera.startswith("bag:"),
                clock=clock,
                on_error=lambda report: common.say(summary(report, verbose=common.Detail.verbose)),
                on_warning=warn,
                on_moment=frame_log.add if frame_log else reconstruct.ignore,
                control=control,
            )

    if log and report.frames:
        common.say(f"Logged each frame to {log}")
    if recording:
        recorded = f"{recording.sets} frames to {recording.path}" if recording.sets else "no frame"
        common.say(f"Recorded {recorded}")
        if recording.error:
            common.say(f"note: {recording.error}")
    text = summary(report, verbose=common.Detail.verbose)
    common.finish(asdict(report), as_json=json, text=text)
    if stop.is_set():
        common.exit_interrupted(f"{report.frames} frames were processed")


def _open_camera(
    camera: str,
    recording: cameras.Recording | None,
    control: loop.RunControl,
    announce: Callable[[], None],
) -> cameras.Camera:
    """Open a camera; while a scene is pre-rendered, announce the view and show the progress."""
    title = "Pre-rendering the simulated scene (first run only, about 90 s)"
    with common.tracked(title, at_once=False) as on_progress:
        on_rendering = viewing.each_of(lambda _, __: announce(), on_progress, control.show_progress)
        return cameras.open_camera(camera, on_progress=on_rendering, recording=recording)


def replay(
    bag: BagFile,
    wall: Wall = None,
    bench_folder: benches.BenchOrWeights = None,
    out: Out = None,
    weights: benches.Weights = None,
    average: Average = 1,
    save_view: viewing.SaveReplayView = False,
    stills: viewing.Stills = 0,
    video: viewing.Video = False,
    as_object: AsObject = "",
    every: Every = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Reconstruct every frame of a recording: the same frames and the same bits each time."""
    formats = object_formats(as_object)
    if every is not None and not formats:
        raise typer.BadParameter(
            f"--every {every} is about the files of --object: give --object, or drop it"
        )
    chosen = benches.choose(bench_folder, wall, weights)
    path = common.output_path(out, "replay", "", overwrite=overwrite)
    with common.interrupted_by_signals():
        opened = cameras.open_camera(f"bag:{bag}")
        bench = chosen.open(opened)
        checks = reconstruct.PeriodicPhysicsCheck(bench.rig, on_error=_warn_once)
        pipeline = _load_pipeline(bench, chosen, average, checks)
    with opened as source, common.stop_on_signals() as stop, common.progress() as bar:
        task = bar.add_task("reconstructing", total=None)
        report = replays.replay_recording(
            source,
            pipeline,
            path,
            stop=stop,
            on_frame=lambda: bar.advance(task),
            on_warning=warn,
            media=replays.ReplayMedia(
                bench, view=save_view, stills=stills, video=video, objects=formats, every=every or 1
            ),
            options=_choice_words(bench_folder, wall, weights, average),
        )
    took = f"Reconstructed {report.frames} frames in {report.seconds:.1f} s"
    text = f"{took}: open {path / replays.REPORT}"
    common.finish(asdict(report), as_json=json, text=text)
    if stop.is_set():
        common.exit_interrupted(f"{path} holds the first {report.frames} frames")


def _choice_words(
    bench_folder: Path | None, wall: Path | None, weights: Path | None, average: int
) -> list[str]:
    """Return the words of the command line that chose bench, weights and average."""
    given = {"--bench": bench_folder, "--wall": wall, "--weights": weights}
    words = [word for name, path in given.items() if path for word in (name, str(path))]
    return words if average == 1 else [*words, "--average", str(average)]


def _check_output(path: Path, option: str, *suffixes: str, overwrite: bool) -> Path:
    """Return the path if it can be written. Raises typer.BadParameter for another suffix."""
    if path.suffix not in suffixes:
        raise typer.BadParameter(
            f"{option} {path}: choose a name that ends in {' or '.join(suffixes)}"
        )
    return common.output_path(path, "live", path.suffix, overwrite=overwrite)


def _load_pipeline(
    bench: reconstruct.CalibratedRig,
    chosen: benches.Choice,
    average: int,
    checks: reconstruct.PhysicsCheck,
) -> reconstruct.Pipeline:
    """Load the networks that serve a bench and build their pipeline."""
    found = chosen.load_networks(bench)
    return reconstruct.build_pipeline(
        bench,
        found.network,
        average,
        uncertainty_model=found.uncertainty_model,
        checks=checks,
        weights=found.weights,
    )


def warn(warning: str, begins: bool) -> None:
    """Print that a warning begins, or ends."""
    common.say(
        f"[yellow]warning:[/] {escape(warning)}" if begins else f"no longer: {escape(warning)}",
        marked=True,
    )


def _warn_once(warning: str) -> None:
    warn(warning, begins=True)


def summary(report: loop.RunReport, *, verbose: bool = False) -> str:
    """Return the report as text, a sentence per line; `verbose` adds the time of each stage."""
    latency = report.latency_ms
    lines = [
        f"{report.frames} frames, {report.fps:.1f} per second",
        (
            f"Latency {latency['p50']:.0f} ms median, {latency['p95']:.0f} ms p95,"
            f" {latency['p99']:.0f} ms p99"
        ),
    ]
    if camera_ms := report.camera_ms:
        lines.append(
            f"Simulating the camera took {camera_ms['p50']:.0f} ms a frame beside it,"
            f" {camera_ms['p99']:.0f} ms p99"
        )
    if quality := report.quality:
        lines.append(
            f"Outline typically {quality['expected_iou']:.0%} right, depth to"
            f" {quality['expected_error_mm']:.0f} mm (predicted)"
        )
    lines += _loss_lines(report)
    if report.verdicts:
        lines.append(_verdict_line(report))
    irregular = {name: count for name, count in report.counts.items() if name not in LOSSES}
    if irregular:
        lines.append(f"Irregular: {reconstruct.describe_counts(irregular)}")
    if report.stalled_s:
        lines.append(f"Stalled for {report.stalled_s:.1f} s without a frame")
    lines += [f"Warning in {frames} frames: {text}" for text, frames in report.warnings.items()]
    if verbose:
        lines += _stage_lines(report)
    return "\n".join(lines)


def _loss_lines(report: loop.RunReport) -> list[str]:
    """Return the lost frames by cause, and a warning if they or the latency are many."""
    lines: list[str] = []
    counts = report.counts
    if report.dropped:
        losses = [f"{counts[name]} {reason}" for name, reason in LOSSES.items() if name in counts]
        lines.append(f"Dropped {report.dropped} frames: {', '.join(losses)}")
    lost = report.dropped / max(report.frames + report.dropped, 1)
    latency_ms = report.latency_ms["p50"]
    if lost > SLOW_DROPPED_SHARE or latency_ms > SLOW_MS:
        lines.append(
            f"Warning: {lost:.0%} of the frames dropped, median latency {latency_ms:.0f} ms: close"
            " other programs"
        )
    return lines


def _verdict_line(report: loop.RunReport) -> str:
    verdicts = [f"{verdict} in {count}" for verdict, count in report.verdicts.items()]
    verdicts[0] = f"{verdicts[0]} of {report.frames} frames".capitalize()
    return ", ".join(verdicts)


def _stage_lines(report: loop.RunReport) -> list[str]:
    """Return a table of the stages, those outside the latency last."""
    stages = report.stages_percentiles_ms.items()
    ordered = sorted(stages, key=lambda stage: stage[0] in loop.OUTSIDE_LATENCY)
    head = f"{'Stage':10}{'median':>9}{'p99 (ms)':>11}"
    return [head] + [f"{name:10}{ms['p50']:9.1f}{ms['p99']:11.1f}" for name, ms in ordered]
