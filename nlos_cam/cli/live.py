"""`nlos-cam live`, `demo` and `replay`: options, messages and the report at the end."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import nlos_models as models
import typer
from rich.markup import escape

from nlos_cam import camera as cameras
from nlos_cam import evaluate as measure
from nlos_cam import live as loop
from nlos_cam import reconstruct
from nlos_cam import view as views
from nlos_cam.cli import common
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
BudgetMs = Annotated[
    float | None,
    typer.Option(
        "--budget-ms", min=0.1, help="Latency budget: use the most accurate setting that meets it."
    ),
]
Tradeoff = Annotated[
    Path | None,
    typer.Option(
        "--tradeoff",
        help="Table of `tradeoff reconstruct` for --budget-ms (default: beside the weights).",
    ),
]
Wall = Annotated[
    Path | None, typer.Option("--wall", help="Wall record of `calibrate --wall` (wall.toml).")
]
Weights = Annotated[
    Path | None,
    typer.Option("--weights", help="Folder of weights, paper, or direct (the default)."),
]
Average = Annotated[
    int,
    typer.Option(
        "--average", min=1, max=1000, help="Number of frames to average; moving objects blur."
    ),
]
BagFile = Annotated[
    Path, typer.Argument(metavar="F.BAG", help="Recording with depth, infrared and confidence.")
]
Out = Annotated[
    Path | None, typer.Option("--out", help="Directory to write (default: a dated one).")
]
Every = Annotated[
    int, typer.Option("--every", min=1, help="With --object, only every Nth frame (default: 1).")
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
    seconds: viewing.Seconds = None,
    no_view: viewing.NoView = False,
    view_port: viewing.ViewPort = None,
    view_host: viewing.ViewHost = None,
    open_view: viewing.Open = False,
    record: RecordTo = None,
    log: Log = None,
    weights: Weights = None,
    average: Average = 1,
    budget_ms: BudgetMs = None,
    tradeoff: Tradeoff = None,
    save_view: viewing.SaveView = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Show what is hidden around the corner, live, in a browser."""
    if budget_ms is not None and average > 1:
        raise typer.BadParameter(
            "--budget-ms chooses the number of averaged frames: drop --average"
        )
    if tradeoff is not None and budget_ms is None:
        raise typer.BadParameter("--tradeoff is the table for --budget-ms: give both")
    if no_view and open_view:
        raise typer.BadParameter("--open needs a view: drop --no-view")
    check_output = partial(_check_output, overwrite=overwrite)
    recorded = check_output(record, "--record", ".bag") if record else None
    recording = (
        cameras.Recording(recorded, optional=True, overwrite=overwrite) if recorded else None
    )
    frame_log = loop.FrameLog(check_output(log, "--log", *loop.LOG_SUFFIXES)) if log else None
    view_file = check_output(save_view, "--save-view", views.SESSION_SUFFIX) if save_view else None
    control = loop.RunControl(camera)
    with viewing.viewer_of(
        control, no_view=no_view, host=view_host, port=view_port
    ) as viewer:  # serves before the camera runs
        announce = cache(
            partial(
                viewing.announce_view, viewer, host=view_host, port=view_port, open_it=open_view
            )
        )
        with common.interrupted_by_signals():
            with common.tracked(
                "Pre-rendering the simulated scene (first run only, about 90 s)", at_once=False
            ) as on_progress:
                on_rendering = viewing.each_of(
                    lambda _, __: announce(), on_progress, control.show_progress
                )
                opened = cameras.open_camera(camera, on_progress=on_rendering, recording=recording)
            announce()
            bench = reconstruct.open_bench(wall, opened)
            checks = loop.BackgroundPhysicsCheck(bench.rig, on_error=_warn_once)
            control.set_state("connecting", "loading the networks, first frame in a few seconds")
            pipeline, choice = _choose_pipeline(
                opened, bench, weights, average, budget_ms, tradeoff, checks
            )
            loop.warm_up(opened, pipeline)
        viewer.begin(bench.rig, bench.measured)
        control.on_bench = lambda bench: viewer.begin(bench.rig, bench.measured)
        loop.offer_settings(control, opened, bench, tradeoff, weights)
        with (
            common.stop_on_signals() as stop,
            loop.realtime_priority(),
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
                clock=cameras.WallClock().now,
                on_error=lambda report: common.say(summary(report, verbose=common.Detail.verbose)),
                on_warning=warn,
                on_moment=frame_log.add if frame_log else loop.ignore,
                control=control,
            )
    if log:
        common.say(f"Logged each frame to {log}")
    if recording:
        common.say(f"Recorded {recording.sets} frames to {recording.path}")
    if view_file:
        common.say(f"Saved the view: open {view_file} in a browser")
    text = summary(report, verbose=common.Detail.verbose)
    budget = {}
    if choice:
        text = f"{text}\n{choice.describe_outcome(report)}"
        budget = {"budget": choice.outcome(report)}
    common.finish({**asdict(report), **budget}, as_json=json, text=text)
    if stop.is_set():
        common.exit_interrupted(f"{report.frames} frames were processed")


def replay(
    bag: BagFile,
    wall: Wall = None,
    out: Out = None,
    weights: Weights = None,
    average: Average = 1,
    save_view: viewing.SaveReplayView = False,
    stills: viewing.Stills = 0,
    video: viewing.Video = False,
    as_object: AsObject = "",
    every: Every = 1,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Reconstruct every frame of a recording: the same frames and the same bits each time."""
    formats = object_formats(as_object)
    path = common.output_path(out, "replay", "", overwrite=overwrite)
    with common.interrupted_by_signals():
        opened = cameras.open_camera(f"bag:{bag}")
        bench = reconstruct.open_bench(wall, opened)
        from nlos_cam.reconstruct import (
            PeriodicPhysicsCheck,
        )  # the renderer takes a second to import

        checks = PeriodicPhysicsCheck(bench.rig, on_error=_warn_once)
        pipeline = _build_pipeline(
            bench,
            reconstruct.load_networks(weights),
            reconstruct.load_uncertainty(weights),
            average,
            checks,
        )
    with opened as source, common.stop_on_signals() as stop, common.progress() as bar:
        task = bar.add_task("reconstructing", total=None)
        report = loop.replay_recording(
            source,
            pipeline,
            path,
            stop=stop,
            on_frame=lambda: bar.advance(task),
            on_warning=warn,
            media=loop.ReplayMedia(
                bench, view=save_view, stills=stills, video=video, objects=formats, every=every
            ),
        )
    text = (
        f"Reconstructed {report.frames} frames in {report.seconds:.1f} s: open {path / loop.REPORT}"
    )
    common.finish(asdict(report), as_json=json, text=text)
    if stop.is_set():
        common.exit_interrupted(f"{path} holds the first {report.frames} frames")


def _check_output(path: Path, option: str, *suffixes: str, overwrite: bool) -> Path:
    """Return the path if it can be written. Raises typer.BadParameter for another suffix."""
    if path.suffix not in suffixes:
        raise typer.BadParameter(
            f"{option} {path}: choose a name that ends in {' or '.join(suffixes)}"
        )
    return common.output_path(path, "live", path.suffix, overwrite=overwrite)


def _runtimes(*which: Any) -> Any:
    """Return `evaluate.runtimes`, which imports torch, once a setting needs it."""
    return measure.runtimes(*which)


def _choose_pipeline(
    camera: cameras.Camera,
    bench: reconstruct.CalibratedRig,
    weights: Path | None,
    average: int,
    budget_ms: float | None,
    tradeoff: Path | None,
    checks: reconstruct.PhysicsCheck,
) -> tuple[reconstruct.Pipeline, loop.BudgetChoice | None]:
    """Return the usual pipeline, or that of a latency budget with its choice."""
    if budget_ms is None:
        return (
            _build_pipeline(
                bench,
                reconstruct.load_networks(weights),
                reconstruct.load_uncertainty(weights),
                average,
                checks,
            ),
            None,
        )
    settings = loop.available_settings(tradeoff, weights)
    load = loop.setting_loader(weights, _runtimes)
    uncertainty_model = reconstruct.load_uncertainty(weights)
    # timed with the uncertainty model of `weights`: others take as long
    build = partial(reconstruct.build_pipeline, bench, uncertainty_model=uncertainty_model)
    network, choice = loop.choose_within_budget(
        budget_ms, settings, build, load, loop.pipeline_timer(camera)
    )
    common.say(choice.describe())
    if choice.setting.weights != loop.SHIPPED:
        uncertainty_model = reconstruct.load_uncertainty(Path(choice.setting.weights))
    return _build_pipeline(bench, network, uncertainty_model, choice.setting.frames, checks), choice


def _build_pipeline(
    bench: reconstruct.CalibratedRig,
    network: models.Reconstructor,
    uncertainty_model: models.UncertaintyModel | None,
    average: int,
    checks: reconstruct.PhysicsCheck,
) -> reconstruct.Pipeline:
    """Build the pipeline, and print the model's name and its mismatches with the bench."""
    common.say(f"Loaded model {network.record.rig_name} ({network.runtime})")
    for warning in reconstruct.compatibility_warnings(bench, network.record, uncertainty_model):
        common.say(f"note: {warning}")
    return reconstruct.build_pipeline(
        bench, network, average, uncertainty_model=uncertainty_model, checks=checks
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
    counts = dict(report.counts)
    losses = [f"{counts.pop(name)} {reason}" for name, reason in LOSSES.items() if name in counts]
    lines = [
        f"{report.frames} frames, {report.fps:.1f} per second",
        (
            f"Latency {latency['p50']:.0f} ms median, {latency['p95']:.0f} ms p95,"
            f" {latency['p99']:.0f} ms p99"
        ),
    ]
    if report.camera_ms:
        middle = report.camera_ms["p50"]
        high = report.camera_ms["p99"]
        lines.append(
            f"Simulating the camera took {middle:.0f} ms a frame beside it, {high:.0f} ms p99"
        )
    if report.quality:
        typical = report.quality["expected_iou"]
        error_mm = report.quality["expected_error_mm"]
        lines.append(
            f"Outline typically {typical:.0%} right, depth to {error_mm:.0f} mm (predicted)"
        )
    if report.dropped:
        lines.append(f"Dropped {report.dropped} frames: {', '.join(losses)}")
    lost = report.dropped / max(report.frames + report.dropped, 1)
    if lost > SLOW_DROPPED_SHARE or latency["p50"] > SLOW_MS:
        slow = f"{lost:.0%} of the frames dropped, median latency {latency['p50']:.0f} ms"
        lines.append(f"Warning: {slow}: close other programs, or give --budget-ms")
    if report.verdicts:
        phrases = {reconstruct.Verdict.SEEN.value: "object detected"}
        verdicts = [
            f"{phrases.get(verdict, verdict)} in {count}"
            for verdict, count in report.verdicts.items()
        ]
        verdicts[0] = f"{verdicts[0]} of {report.frames} frames".capitalize()
        lines.append(", ".join(verdicts))
    if counts:
        lines.append(f"Irregular: {loop.describe_counts(counts)}")
    if report.stalled_s:
        lines.append(f"Stalled for {report.stalled_s:.1f} s without a frame")
    lines += [f"Warning in {frames} frames: {text}" for text, frames in report.warnings.items()]
    if verbose:
        lines.append(f"{'Stage':10}{'median':>9}{'p99 (ms)':>11}")
        stages = sorted(
            report.stages_percentiles_ms.items(), key=lambda stage: stage[0] in loop.OUTSIDE_LATENCY
        )
        lines += [f"{name:10}{times['p50']:9.1f}{times['p99']:11.1f}" for name, times in stages]
    return "\n".join(lines)
