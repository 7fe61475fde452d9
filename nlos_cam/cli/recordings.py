"""`nlos-cam repair`: what is whole in a killed, cut or damaged recording, in a new file."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from nlos_cam.camera.repair import Repaired, repair
from nlos_cam.cli.common import Json, Overwrite, finish, interrupted_by_signals, output_path, tracked

BagFile = Annotated[Path, typer.Argument(metavar="F.BAG", help="A recording that was killed, cut short or damaged.")]
Out = Annotated[Path | None, typer.Option("--out", help="The recording to write (.bag).")]
MOST_TOLD = 5


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("repair")(repair_bag)


def repair_bag(bag: BagFile, out: Out = None, overwrite: Overwrite = False, json: Json = False) -> None:
    """Write every whole piece of a recording, and a new index, to a new recording; the old one stays as it is."""
    if out is not None and out.suffix != ".bag":
        raise typer.BadParameter(f"--out {out}: a recording's name ends in .bag")
    path = output_path(out, "repaired", ".bag", overwrite=overwrite)
    with interrupted_by_signals(), tracked("repairing") as report:
        found = repair(bag, path, report)
    result = {
        "recovered_frames": found.recovered_frames,
        "chunks": found.chunks,
        "damaged": len(found.damages),
        "out": str(path),
    }
    finish(result, as_json=json, text=escape(_told(found)))


def _told(found: Repaired) -> str:
    frames = ", ".join(f"{count} {stream}" for stream, count in found.recovered_frames.items())
    lost = sum(damage.bytes for damage in found.damages)
    told = [f"recovered {found.chunks} pieces with {frames} frames; lost {lost} bytes"]
    told += [f"at byte {damage.position}: {damage.why}" for damage in found.damages[:MOST_TOLD]]
    if (more := len(found.damages) - MOST_TOLD) > 0:
        told.append(f"and at {more} more places")
    return "\n".join([*told, f"wrote {found.out}"])
