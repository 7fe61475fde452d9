"""`nlos-cam capture`: record a live camera, in one take or several, and read each recording back.

What `nlos-cam capture` tells of its takes: JSON, a sentence, and the error that ended them.
"""

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

from nlos_cam.camera import FRAMES_PER_S, Camera, Recording, check_room, free_bytes, open_camera, recording_s
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
from nlos_cam.errors import NlosCamError
from nlos_cam.recording import (
    CaptureResult,
    CaptureSession,
    CaptureTarget,
    State,
    Summary,
    Verified,
    settle,
    sidecar_path,
    verify,
    wall_of,
)

FIGURES = ("saturated_share", "invalid_share", "temporal_noise_mm")


def result(takes: Sequence[CaptureResult], *, several: bool) -> dict[str, Any]:
    """One take as it is, several as {"takes": [...]} with totals; with the error that ended them, if one did."""
    made = _all([_one(take) for take in takes], several=several)
    if error := ending(takes[-1]):
        made["error"] = {"type": type(error).__name__, "message": str(error)}
    return made


def nothing(jobs: Sequence[CaptureTarget], *, several: bool) -> dict[str, Any]:
    """The same where it was interrupted before the camera ran."""
    none = Summary(frames=0, dropped=0, seconds=0.0, streams={}, events={})
    return _all([_told_of(job, "interrupted", none, sidecar_path(job.path)) for job in jobs[:1]], several=several)


def _all(each: list[dict[str, Any]], *, several: bool) -> dict[str, Any]:
    totals = {key: sum(one[key] or 0 for one in each) for key in ("frames", "dropped", "seconds")}
    return {"takes": each} | totals if several else each[0]


def _one(take: CaptureResult) -> dict[str, Any]:
    return _told_of(take.job, take.state, take.summary, take.sidecar.path)


def _told_of(job: CaptureTarget, state: State, summary: Summary, sidecar: Path) -> dict[str, Any]:
    made: dict[str, Any] = {
        "frames": summary.frames,
        "dropped": summary.dropped,
        "seconds": None if summary.seconds is None else round(summary.seconds, 3),
        "out": str(job.path),
        "state": state,
        "streams": summary.streams,
        **{key: getattr(summary, key) for key in FIGURES},
        "sidecar": str(sidecar),
    }
    return made if job.label is None else made | {"label": job.label}


def ending(take: CaptureResult) -> NlosCamError | None:
    """What ended a take and is no one's wish, and how much of it is kept."""
    if take.error is None:
        return None
    kept = f"{take.found.frames} frames are kept in {take.job.path}" if take.found else "nothing is kept"
    return take.error if take.sets and not take.found else type(take.error)(f"{take.error}; {kept}")


def told(take: CaptureResult) -> str:
    """A take for a person."""
    if take.sets == 0:
        return f"{take.state} before the first frame: nothing is kept"
    if take.found is None:
        return f"{take.state}: {take.sets} frames came, not read back\nwrote {take.job.path}"
    size_mb, state = take.job.path.stat().st_size / 1e6, "" if take.state == "complete" else f"{take.state}: "
    return (
        f"{state}{take.found.frames} frames, {take.found.seconds:.1f} s, {size_mb:.0f} MB, read back whole\n"
        f"{_figures(take.summary)}\nwrote {take.job.path}"
    )


def _figures(summary: Summary) -> str:
    noise = "unknown" if summary.temporal_noise_mm is None else f"{summary.temporal_noise_mm:.2f} mm"
    saturated, invalid = summary.saturated_share or 0.0, summary.invalid_share or 0.0
    return f"saturated {saturated:.2%}, without depth {invalid:.1%}, noise in time {noise}"


CameraUri = Annotated[str, typer.Option("--camera", help="l515, l515:SERIAL, sim, sim:bare-wall or sim:SCENE.toml.")]
ENDLESS_S = 1e9
"""More than any disk holds; infinity is no number of frames."""
Seconds = Annotated[
    float | None, typer.Option("--seconds", min=1 / FRAMES_PER_S, max=ENDLESS_S, help="Stop after so long.")
]
Frames = Annotated[int | None, typer.Option("--frames", min=1, help="Stop after so many frames.")]
TakeCount = Annotated[int, typer.Option("--takes", min=1, max=9999, help="So many in a row: F-01.bag, F-02.bag, ...")]
Pause = Annotated[
    float | None,
    typer.Option(
        "--pause-s", min=0.0, max=ENDLESS_S, help="Seconds between takes; else Enter begins the next, on a terminal."
    ),
]
Labels = Annotated[
    list[str] | None,
    typer.Option("--label", help="A name for what is seen, kept in F.json beside F.bag; with --takes one, or each."),
]
Wall = Annotated[Path | None, typer.Option("--wall", help="The wall as `calibrate --wall` found it, for F.json.")]
Out = Annotated[Path | None, typer.Option("--out", help="The recording to write (.bag).")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(capture)


def capture(
    camera: CameraUri,
    seconds: Seconds = None,
    frames: Frames = None,
    takes: TakeCount = 1,
    pause_s: Pause = None,
    label: Labels = None,
    wall: Wall = None,
    out: Out = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Record depth, infrared and confidence to .bag until --seconds, --frames or Ctrl-C, and verify each file."""
    jobs = _jobs(_base(seconds, frames, takes, out), takes, label or [], overwrite=overwrite)
    measured = wall_of(wall) if wall else None
    recording = Recording(jobs[0].path, frames=frames, seconds=seconds, last=takes == 1)
    try:
        with interrupted_by_signals(), tracked("rendering the world ahead") as on_progress:
            source = open_camera(camera, on_progress=on_progress, recording=recording)
    except KeyboardInterrupt:
        finish(
            nothing(jobs, several=takes > 1), as_json=json, text="interrupted before the first frame: nothing is kept"
        )
        raise typer.Exit(INTERRUPTED) from None
    each = frames or (round(seconds * FRAMES_PER_S) if seconds else None)
    _check_disk(source, jobs, each)
    with stop_on_signals() as stop:
        made = _make(CaptureSession(source, recording, jobs, wall=measured), stop, each, pause_s)
        interrupted = stop.is_set() or made[-1].state == "interrupted"
    finish(result(made, several=takes > 1), as_json=json, text="\n".join(map(told, made)))
    if failure := ending(made[-1]):
        say(f"[bold red]error:[/] {escape(str(failure))}", marked=True)
        raise typer.Exit(failure.exit_code)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _base(seconds: float | None, frames: int | None, takes: int, out: Path | None) -> Path:
    """The name that takes are numbered after. Raises typer.BadParameter for arguments that contradict each other."""
    if seconds is not None and frames is not None:
        raise typer.BadParameter("give one of --seconds and --frames")
    if takes > 1 and seconds is None and frames is None:
        raise typer.BadParameter(f"--takes {takes}: say how long each is, with --seconds or --frames")
    if out is not None and out.suffix != ".bag":
        raise typer.BadParameter(f"--out {out}: a recording's name ends in .bag")
    return out or output_path(None, "capture", ".bag", overwrite=False)


def _jobs(base: Path, takes: int, labels: list[str], *, overwrite: bool) -> list[CaptureTarget]:
    """What is to be recorded where. Raises OutputExistsError where that would replace something unasked."""
    if len(labels) not in {0, 1, takes}:
        raise typer.BadParameter(f"{len(labels)} --label for {takes} takes: give one for all, or one for each")
    digits = max(2, len(str(takes)))
    paths = [base.with_stem(f"{base.stem}-{number:0{digits}}") for number in range(1, takes + 1)]
    jobs = list(
        map(
            CaptureTarget,
            paths if takes > 1 else [base],
            labels * takes if len(labels) == 1 else labels or [None] * takes,
        )
    )
    for job in jobs:
        for path in (job.path, sidecar_path(job.path)):
            output_path(path, "", path.suffix, overwrite=overwrite)
    return jobs


def _check_disk(camera: Camera, jobs: list[CaptureTarget], each: int | None) -> None:
    """Raises DiskFullError where they may not fit; says how long there is room where no limit was given."""
    path, free = jobs[0].path, free_bytes(jobs[0].path)
    check_room(path, camera.intrinsics, (each or 0) * len(jobs), free)
    if each is None:
        minutes = recording_s(camera.intrinsics, free) / 60
        say(f"there is room for {minutes:.1f} minutes or more ({free / 1e9:.1f} GB free); Ctrl-C ends it")


def _make(takes: CaptureSession, stop: Event, each: int | None, pause_s: float | None) -> list[CaptureResult]:
    """Record the takes, one after another, and read each back."""
    made: list[CaptureResult] = []
    with progress() as bar:
        task = bar.add_task("recording", total=each)
        with closing(takes.record(stop, lambda sets: bar.update(task, completed=sets))) as recorded:
            for take in recorded:
                made.append(settle(take, partial(_read_back, bar, take.sets)))
                if dropped := made[-1].summary.dropped:
                    say(f"[yellow]{dropped} frames never came:[/] the recording has gaps", marked=True)
                if made[-1].state != "complete" or stop.is_set():
                    break
                if left := len(takes.jobs) - len(made):
                    _pause(bar, stop, pause_s, f"{told(made[-1])}\n{left} more to take")
                    bar.reset(task)
                if stop.is_set():
                    break
    return made


def _read_back(bar: Progress, sets: int, path: Path) -> Verified | None:
    """What the closed file holds; None if Ctrl-C came first."""
    task = bar.add_task("reading it back", total=sets)
    try:
        with interrupted_by_signals():
            return verify(path, on_frame=lambda: bar.advance(task))
    except KeyboardInterrupt:
        return None
    finally:
        bar.remove_task(task)


def _pause(bar: Progress, stop: Event, pause_s: float | None, text: str) -> None:
    """Wait so long, or for Enter on a terminal; Ctrl-C sets `stop`."""
    say(text)
    if pause_s is not None or not sys.stdin.isatty():
        stop.wait(pause_s or 0.0)
        return
    bar.stop()
    say("press Enter to begin the next take")
    try:
        with interrupted_by_signals():
            sys.stdin.readline()
    except KeyboardInterrupt:
        stop.set()
    bar.start()
