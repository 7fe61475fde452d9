"""`nlos-cam repair` and `nlos-cam export`: what is whole in a damaged recording, and frames as files."""

from pathlib import Path
from typing import Annotated

import typer

from nlos_cam.cli.common import (
    INTERRUPTED,
    Json,
    Overwrite,
    finish,
    interrupted_by_signals,
    output_path,
    progress,
    stop_on_signals,
    tracked,
)
from nlos_cam.errors import RecordingError
from nlos_cam.recording import BagFile, Exported, Format, Repaired, Wanted, export_recording, repair_recording

DamagedBag = Annotated[Path, typer.Argument(metavar="F.BAG", help="A recording that was killed, cut short or damaged.")]
NewBag = Annotated[Path | None, typer.Option("--out", help="The recording to write (.bag).")]
AnyBag = Annotated[Path, typer.Argument(metavar="F.BAG", help="A recording, of any RealSense camera.")]
Folder = Annotated[Path | None, typer.Option("--out", help="The folder to write.")]
As = Annotated[Format, typer.Option("--format", help="png: a 16-bit PNG a frame. npz: one file a stream.")]
Ply = Annotated[
    bool, typer.Option("--ply", help="A point cloud (PLY, metres, lidar frame) for each frame, not the first only.")
]
Streams = Annotated[str, typer.Option("--streams", help="Only these: names with commas between.")]
Every = Annotated[int, typer.Option("--every", min=1, help="Only frames whose number this divides.")]
MAX_REPORTED = 5


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("repair")(repair_bag)
    app.command("export")(export_bag)


def repair_bag(bag: DamagedBag, out: NewBag = None, overwrite: Overwrite = False, json: Json = False) -> None:
    """Write every whole piece of a recording, and a new index, to a new recording; the old one stays as it is."""
    if out is not None and out.suffix != ".bag":
        raise typer.BadParameter(f"--out {out}: a recording's name ends in .bag")
    path = output_path(out, "repaired", ".bag", overwrite=overwrite)
    with interrupted_by_signals(), tracked("repairing") as report:
        found = repair_recording(bag, path, report)
    result = {
        "recovered_frames": found.recovered_frames,
        "chunks": found.chunks,
        "damaged": len(found.damages),
        "out": str(path),
    }
    finish(result, as_json=json, text=_told_repair(found))


def _told_repair(found: Repaired) -> str:
    frames = ", ".join(f"{count} {stream}" for stream, count in found.recovered_frames.items())
    lost = sum(damage.bytes for damage in found.damages)
    told = [f"recovered {found.chunks} pieces with {frames} frames; lost {lost} bytes"]
    told += [f"at byte {damage.position}: {damage.why}" for damage in found.damages[:MAX_REPORTED]]
    if (more := len(found.damages) - MAX_REPORTED) > 0:
        told.append(f"and at {more} more places")
    return "\n".join([*told, f"wrote {found.out}"])


def export_bag(
    bag: AnyBag,
    out: Folder = None,
    form: As = "png",
    ply: Ply = False,
    streams: Streams = "",
    every: Every = 1,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Write a recording's frames as files, with their timestamps, intrinsics and settings."""
    folder = output_path(out, "export", "", overwrite=overwrite)
    names = [name.strip() for name in streams.split(",") if name.strip()]
    wanted, found = Wanted(form, ply, names, every), BagFile(bag)
    total = sum(info.frames for name, info in found.streams.items() if not names or name in names)
    with stop_on_signals() as stop, progress() as bar:
        task = bar.add_task("exporting", total=total)
        made = export_recording(found, folder, wanted, stop=stop, on_frame=lambda: bar.advance(task))
    if made.damage:
        raise RecordingError(f"{made.damage}; what comes before that is in {folder}")
    finish({"frames": made.frames, "out": made.out}, as_json=json, text=_told_export(made))
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def _told_export(made: Exported) -> str:
    written = ", ".join(f"{count} {name}" for name, count in made.frames.items())
    return f"{written}\nwrote {made.out}"
