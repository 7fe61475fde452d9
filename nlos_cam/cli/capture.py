"""`nlos-cam capture`: record a live camera in one or several takes, and verify each recording."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from threading import Event
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.progress import Progress

from nlos_cam import camera as cameras
from nlos_cam import recording as recordings
from nlos_cam.cli import benches, common
from nlos_cam.errors import NlosCamError

FIGURES = ("saturated_share", "invalid_share", "temporal_noise_mm")
ENDINGS: dict[recordings.TakeState, str] = {
    "interrupted": "Interrupted. ",
    "lost": "Camera lost. ",
    "disk full": "Disk full. ",
    "size limit": "Limit on a file's size reached. ",
    "file gone": "File gone. ",
    "damaged": "File damaged. ",
}
NOTHING = "nothing was recorded"
PRE_RENDERING = "Pre-rendering the simulated scene (first run only, about 90 s)"


def result_of(takes: Sequence[recordings.CaptureResult], *, several: bool) -> dict[str, Any]:
    """Return the takes for JSON: one as it is, several as {"takes": [...]} with totals; with the
    error of the last.
    """
    each = [
        _take_fields(take.target, take.state, take.summary, take.sidecar.path) for take in takes
    ]
    result = _with_totals(each) if several else each[0]
    if error := final_error(takes[-1]):
        result["error"] = {"type": type(error).__name__, "message": str(error)}
    return result


def empty_result(target: recordings.CaptureTarget, *, several: bool) -> dict[str, Any]:
    """Return the same fields for an interruption before the camera started."""
    empty = recordings.Summary(frames=0, dropped=0, seconds=0.0, streams={}, events={})
    fields = _take_fields(target, "interrupted", empty, recordings.sidecar_path(target.path))
    return _with_totals([fields]) if several else fields


def _with_totals(each: list[dict[str, Any]]) -> dict[str, Any]:
    return {"takes": each} | {
        key: sum(one[key] or 0 for one in each) for key in ("frames", "dropped", "seconds")
    }


def _take_fields(
    target: recordings.CaptureTarget,
    state: recordings.TakeState,
    summary: recordings.Summary,
    sidecar: Path,
) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "frames": summary.frames,
        "dropped": summary.dropped,
        "seconds": None if summary.seconds is None else round(summary.seconds, 3),
        "out": str(target.path),
        "state": state,
        "streams": summary.streams,
        **{key: getattr(summary, key) for key in FIGURES},
        "sidecar": str(sidecar),
    }
    return fields if target.label is None else fields | {"label": target.label}


def final_error(take: recordings.CaptureResult) -> NlosCamError | None:
    """Return the error that ended a take, with the number of frames saved; None if its limit or the
    user ended it.
    """
    if take.error is None:
        return None
    if take.recoverable is not None:
        count = f"{take.summary.frames} of the {take.sets} frames that came are in it"
        return type(take.error)(f"{take.error}; {count}")
    if take.sets and not take.verified:
        return take.error
    saved = (
        f"{take.verified.frames} frames are saved in {take.target.path}"
        if take.verified
        else NOTHING
    )
    return type(take.error)(f"{take.error}; {saved}")


def format_take(take: recordings.CaptureResult) -> str:
    """Return the lines that report a take at the terminal."""
    ending = ENDINGS.get(take.state, "")
    if take.sets == 0:
        return f"{ending.rstrip('. ')} before the first frame; {NOTHING}"
    if take.recoverable is not None:
        frames = f"{take.summary.frames} of {take.sets} frames"
        return f"{ending}Recorded {frames}; the file has no index\nWrote {take.target.path}"
    if not take.closed:
        return f"{ending}{take.sets} frames came; the file cannot be read back"
    if take.verified is None:
        return f"{ending}Recorded {take.sets} frames; not verified\nWrote {take.target.path}"
    size_mb = take.target.path.stat().st_size / 1e6
    summary = take.summary
    noise_mm = summary.temporal_noise_mm
    noise = "unknown" if noise_mm is None else f"{noise_mm:.2f} mm"
    verified = "" if take.state == "damaged" else "; verified"
    saturated = f"{100 * (summary.saturated_share or 0.0):.2f} % saturated"
    missing = f"{100 * (summary.invalid_share or 0.0):.1f} % missing depth"
    seconds = f"{take.verified.seconds:.1f} s"
    return (
        f"{ending}Recorded {take.verified.frames} frames ({seconds}, {size_mb:.0f} MB){verified}\n"
        f"{saturated}, {missing}, temporal noise {noise}\n"
        f"Wrote {take.target.path}"
    )


def format_takes(
    results: Sequence[recordings.CaptureResult], targets: Sequence[recordings.CaptureTarget]
) -> str:
    """Return the lines that report the whole capture: a single take, or the sum of several."""
    if len(targets) == 1:
        return format_take(results[0])
    frames = sum(take.summary.frames or 0 for take in results)
    return f"Recorded {len(results)} of {len(targets)} takes, {frames} frames in all"


Seconds = Annotated[
    float | None,
    typer.Option(
        "--seconds",
        min=0.03,
        max=common.MAX_S,
        help="Stop after this many seconds (default: run until Ctrl-C).",
    ),
]
Frames = Annotated[int | None, typer.Option("--frames", min=1, help="Stop after this many frames.")]
TakeCount = Annotated[
    int, typer.Option("--takes", min=1, max=9999, help="Number of takes: F-01.bag, F-02.bag, ...")
]
Pause = Annotated[
    float | None,
    typer.Option(
        "--pause-s",
        min=0.0,
        max=common.MAX_S,
        help="With --takes, seconds between them (default: wait for Enter, at a terminal).",
    ),
]
Labels = Annotated[
    list[str] | None,
    typer.Option(
        "--label",
        help="Name of the recorded object, stored in F.json; with --takes, once or for each.",
    ),
]
Wall = Annotated[
    Path | None, typer.Option("--wall", help="Wall record of `calibrate --wall`, stored in F.json.")
]
Out = Annotated[Path | None, typer.Option("--out", help="Recording to write (.bag).")]


def capture(
    camera: common.Camera = "sim",
    seconds: Seconds = None,
    frames: Frames = None,
    takes: TakeCount = 1,
    pause_s: Pause = None,
    label: Labels = None,
    wall: Wall = None,
    bench_folder: benches.BenchFolder = None,
    out: Out = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Record depth, infrared and confidence to .bag until --seconds, --frames or Ctrl-C, and verify
    each file.
    """
    base = _base(seconds, frames, takes, pause_s, out)
    targets = _targets(base, takes, label or [], overwrite=overwrite)
    chosen = benches.choose(bench_folder, wall, reconstructs=False)
    measured = chosen.recorded_wall
    recording = cameras.Recording(
        targets[0].path, frames=frames, seconds=seconds, last=takes == 1, overwrite=overwrite
    )
    try:
        with (
            common.interrupted_by_signals(),
            common.tracked(PRE_RENDERING, at_once=False) as on_progress,
        ):
            source = cameras.open_camera(camera, on_progress=on_progress, recording=recording)
    except KeyboardInterrupt:
        result = empty_result(targets[0], several=takes > 1)
        text = f"Interrupted before the first frame; {NOTHING}"
        common.finish(result, as_json=json, text=text)
        common.exit_interrupted(NOTHING)
    if chosen.bench:
        chosen.bench.for_camera(source)  # a recording of another camera is refused now, not later
    limit = frames or (round(seconds * cameras.FRAMES_PER_S) if seconds else None)
    _check_disk(source, targets, limit)
    with common.stop_on_signals() as stop:
        results = _record(
            recordings.CaptureSession(source, recording, targets, wall=measured),
            stop,
            limit,
            pause_s,
        )
        interrupted = stop.is_set() or results[-1].state == "interrupted"
    common.finish(
        result_of(results, several=takes > 1),
        as_json=json,
        text=format_takes(results, targets),
    )
    if error := final_error(results[-1]):
        common.say(f"[bold red]error:[/] {escape(str(error))}", marked=True)
        raise typer.Exit(error.exit_code)
    if interrupted:
        common.exit_interrupted(f"{sum(take.sets for take in results)} frames are kept")


def _base(
    seconds: float | None, frames: int | None, takes: int, pause_s: float | None, out: Path | None
) -> Path:
    """Return the path before takes are numbered. Raises typer.BadParameter for options that
    contradict each other.
    """
    if seconds is not None and frames is not None:
        raise typer.BadParameter("give either --seconds or --frames, not both")
    if takes > 1 and seconds is None and frames is None:
        raise typer.BadParameter(f"--takes {takes} needs --seconds or --frames")
    if takes == 1 and pause_s is not None:
        raise typer.BadParameter(
            f"--pause-s {pause_s:g} is the time between takes: give --takes, or drop it"
        )
    if out is not None and out.suffix != ".bag":
        raise typer.BadParameter(f"--out {out}: the name of a recording must end in .bag")
    return out or common.output_path(None, "capture", ".bag", overwrite=False)


def _targets(
    base: Path, takes: int, labels: list[str], *, overwrite: bool
) -> list[recordings.CaptureTarget]:
    """Return file and label of each take. Raises OutputExistsError for a file that may not be
    overwritten.
    """
    if len(labels) not in {0, 1, takes}:
        raise typer.BadParameter(
            f"{len(labels)} --label for {takes} takes: give one for all, or one for each"
        )
    digits = max(2, len(str(takes)))
    numbered = [base.with_stem(f"{base.stem}-{number:0{digits}}") for number in range(1, takes + 1)]
    paths = numbered if takes > 1 else [base]
    each = labels * takes if len(labels) == 1 else labels or [None] * takes
    targets = [recordings.CaptureTarget(*pair) for pair in zip(paths, each, strict=True)]
    for target in targets:
        for path in (target.path, recordings.sidecar_path(target.path)):
            common.output_path(path, "", path.suffix, overwrite=overwrite)
    return targets


def _check_disk(
    camera: cameras.Camera, targets: list[recordings.CaptureTarget], limit: int | None
) -> None:
    """Raise DiskFullError where the takes may not fit; without a limit of frames, print how long
    the disk lasts.
    """
    path = targets[0].path
    free = cameras.free_bytes(path)
    cameras.check_room(path, camera.intrinsics, (limit or 0) * len(targets), free)
    if limit is None:
        lasts_s = cameras.recording_s(camera.intrinsics, free)
        time = f"{int(lasts_s / 60)} minutes" if lasts_s >= 120 else f"{int(lasts_s)} s"
        common.say(
            f"Disk space for at least {time} ({free / 1e9:.1f} GB free). Press Ctrl-C to stop."
        )


def _record(
    session: recordings.CaptureSession, stop: Event, limit: int | None, pause_s: float | None
) -> list[recordings.CaptureResult]:
    results: list[recordings.CaptureResult] = []
    with common.progress() as bar:
        task = bar.add_task("recording", total=limit)
        with closing(
            session.record(stop, lambda sets: bar.update(task, completed=sets))
        ) as recorded:
            for take in recorded:
                result = recordings.finalize(take, partial(_verify, bar, take.sets))
                results.append(result)
                if len(session.targets) > 1:
                    common.say(format_take(result))
                if dropped := result.summary.dropped:
                    common.say(
                        f"[yellow]Warning:[/] {dropped} frames were dropped; the recording has"
                        " gaps",
                        marked=True,
                    )
                if result.state != "complete" or stop.is_set():
                    break
                if left := len(session.targets) - len(results):
                    takes = "1 take" if left == 1 else f"{left} takes"
                    _pause(bar, stop, pause_s, f"{takes} left")
                    bar.reset(task)
                if stop.is_set():
                    break
    return results


def _verify(bar: Progress, sets: int, path: Path) -> recordings.VerifyResult | None:
    """Return the contents of a closed file; None on Ctrl-C."""
    task = bar.add_task("verifying", total=sets)
    try:
        with common.interrupted_by_signals():
            return recordings.verify(path, on_frame=lambda: bar.advance(task))
    except KeyboardInterrupt:
        return None
    finally:
        bar.remove_task(task)


def _pause(bar: Progress, stop: Event, pause_s: float | None, text: str) -> None:
    """Print `text` and wait `pause_s`, or for Enter at a terminal; Ctrl-C sets `stop`."""
    if pause_s is not None or not sys.stdin.isatty():
        common.say(text)
        stop.wait(pause_s or 0.0)
        return
    bar.stop()
    common.ask(text)
    common.ask("Press Enter to start the next take")
    try:
        with common.interrupted_by_signals():
            sys.stdin.readline()
    except KeyboardInterrupt:
        stop.set()
    bar.start()
