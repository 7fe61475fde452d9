"""`nlos-cam capture`: record a live camera, and read the recording back."""

import json as json_module
from pathlib import Path
from threading import Event
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID

from nlos_cam.camera import Camera, Recording, open_camera
from nlos_cam.camera.replay import Verified, verify
from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, progress, say, stop_on_signals
from nlos_cam.errors import RecordingError

CameraUri = Annotated[str, typer.Option("--camera", help="l515, l515:SERIAL, sim, sim:bare-wall or sim:SCENE.toml.")]
Seconds = Annotated[float | None, typer.Option("--seconds", min=1 / FRAMES_PER_S, help="Stop after so long.")]
Frames = Annotated[int | None, typer.Option("--frames", min=1, help="Stop after so many frames.")]
Label = Annotated[str | None, typer.Option("--label", help="A name for what is seen, kept in F.json beside F.bag.")]
Out = Annotated[Path | None, typer.Option("--out", help="The recording to write (.bag).")]
INTERRUPTED = 130


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(capture)


def capture(
    camera: CameraUri,
    seconds: Seconds = None,
    frames: Frames = None,
    label: Label = None,
    out: Out = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Record depth, infrared and confidence to .bag until --seconds, --frames or Ctrl-C, and verify the file."""
    path = _checked(seconds, frames, out, overwrite=overwrite)
    note = _checked_note(path, label, overwrite=overwrite)
    recording = Recording(path, frames=frames, seconds=seconds)
    total = frames or (round(seconds * FRAMES_PER_S) if seconds else None)
    with progress() as bar:
        interrupted = _record(camera, recording, bar, total)
    found = _verified(recording)
    result = {"frames": found.frames, "dropped": found.dropped, "seconds": round(found.seconds, 3), "out": str(path)}
    _write_note(note, camera, label, overwrite=overwrite)
    if label is not None:
        result["label"] = label
    finish(result, as_json=json, text=_told(found, path))
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _checked(seconds: float | None, frames: int | None, out: Path | None, *, overwrite: bool) -> Path:
    """The path to write. Raises typer.BadParameter for arguments that contradict each other."""
    if seconds is not None and frames is not None:
        raise typer.BadParameter("give one of --seconds and --frames")
    if out is not None and out.suffix != ".bag":
        raise typer.BadParameter(f"--out {out}: a recording's name ends in .bag")
    return output_path(out, "capture", ".bag", overwrite=overwrite)


def _checked_note(path: Path, label: str | None, *, overwrite: bool) -> Path:
    """The file beside the recording that keeps the label: the SDK's recorder has no place for it."""
    note = path.with_suffix(".json")
    return note if label is None else output_path(note, "", "", overwrite=overwrite)


def _write_note(note: Path, camera: str, label: str | None, *, overwrite: bool) -> None:
    if label is not None:
        note.write_text(json_module.dumps({"label": label, "camera": camera}) + "\n", encoding="utf-8")
    elif overwrite:  # the label of the recording that was replaced
        note.unlink(missing_ok=True)


def _record(uri: str, recording: Recording, bar: Progress, total: int | None) -> bool:
    """Record until it is full; True if Ctrl-C came first."""
    rendering = bar.add_task("rendering the world ahead", visible=False)

    def on_progress(done: int, of: int) -> None:
        bar.update(rendering, completed=done, total=of, visible=done < of)

    source = open_camera(uri, on_progress=on_progress, recording=recording)
    task = bar.add_task(f"recording {escape(uri)}", total=total)
    with stop_on_signals() as stop, source:
        return _watch(source, bar, task, stop)


def _watch(source: Camera, bar: Progress, task: TaskID, stop: Event) -> bool:
    for _ in source:
        bar.advance(task)
        if stop.is_set():
            return True
    return False


def _verified(recording: Recording) -> Verified:
    """What the closed file holds. Raises RecordingError where that is less than what was seen to pass."""
    found = verify(recording.path)
    if found.frames < recording.sets:
        raise RecordingError(
            f"{recording.path} holds {found.frames} of the {recording.sets} frames that came: check the disk's free "
            "space and speed, and record again"
        )
    if found.dropped:
        say(f"[yellow]{found.dropped} frames never came:[/] the recording has gaps")
    return found


def _told(found: Verified, path: Path) -> str:
    size_mb = path.stat().st_size / 1e6
    return f"{found.frames} frames, {found.seconds:.1f} s, {size_mb:.0f} MB, read back whole\nwrote {escape(str(path))}"
