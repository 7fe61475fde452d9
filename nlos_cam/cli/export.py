"""`nlos-cam export`: a recording as pictures, arrays and point clouds."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from nlos_cam.camera.bag_file import BagFile
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, progress, stop_on_signals
from nlos_cam.errors import RecordingError
from nlos_cam.export import Exported, Format, Wanted, export

INTERRUPTED = 130
BagPath = Annotated[Path, typer.Argument(metavar="F.BAG", help="A recording, of any RealSense camera.")]
Out = Annotated[Path | None, typer.Option("--out", help="The folder to write.")]
As = Annotated[Format, typer.Option("--format", help="png: a 16-bit PNG a frame. npz: one file a stream.")]
Ply = Annotated[bool, typer.Option("--ply", help="Also a point cloud (PLY, metres, lidar frame) for each frame.")]
Streams = Annotated[str, typer.Option("--streams", help="Only these: names with commas between.")]
Every = Annotated[int, typer.Option("--every", min=1, help="Only frames whose number this divides.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export")(export_bag)


def export_bag(
    bag: BagPath,
    out: Out = None,
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
        made = export(found, folder, wanted, stop=stop, on_frame=lambda: bar.advance(task))
    if made.damage:
        raise RecordingError(f"{made.damage}; the {sum(made.frames.values())} frames before that are in {folder}")
    finish({"frames": made.frames, "out": made.out}, as_json=json, text=_told(made))
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def _told(made: Exported) -> str:
    written = ", ".join(f"{count} {name}" for name, count in made.frames.items())
    return f"{written}\nwrote {escape(made.out)}"
