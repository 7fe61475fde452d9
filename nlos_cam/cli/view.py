"""`nlos-cam view`, and what `live` and `replay` share with it: a saved view is looked at again."""

from pathlib import Path
from typing import Annotated

import typer

from nlos_cam.cli.common import INTERRUPTED, Json, finish, interrupted_by_signals, stop_on_signals
from nlos_cam.cli.live_view import Open, ViewHost, ViewPort, tell_of_view
from nlos_cam.reconstruct.bench import Bench
from nlos_cam.view.assets import LOOPBACK
from nlos_cam.view.viewer import Viewer, Viewers

SUFFIX = ".rrd"
SaveView = Annotated[Path | None, typer.Option("--save-view", help="Also save the view (F.rrd), for `nlos-cam view`.")]
SaveReplayView = Annotated[bool, typer.Option("--save-view", help="Also write DIR/view.rrd, for `nlos-cam view`.")]
Stills = Annotated[int, typer.Option("--stills", min=0, max=100, help="Also write so many still pictures (PNG).")]
Video = Annotated[bool, typer.Option("--video", help="Also write DIR/replay.webm.")]
ViewFile = Annotated[Path, typer.Argument(metavar="F.RRD", help="What --save-view wrote.")]
Seconds = Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after so long; else at Ctrl-C.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("view")(view)


def view(
    file: ViewFile,
    seconds: Seconds = None,
    view_port: ViewPort = None,
    view_host: ViewHost = None,
    open_view: Open = False,
    json: Json = False,
) -> None:
    """Look at a saved view in a browser, with play, pause and scrubbing."""
    from nlos_cam.view.web import RecordedView

    with interrupted_by_signals():
        recorded = RecordedView(file, host=view_host or LOOPBACK, port=view_port)
    with stop_on_signals() as stop, recorded:
        tell_of_view(recorded, host=view_host, port=view_port, open_it=open_view, what="saved view")
        address = recorded.address
        stop.wait(seconds)
    finish({"file": str(file), "address": address}, as_json=json, text=f"{file} was at {address}")
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def saving(viewer: Viewer, bench: Bench, path: Path | None) -> Viewer:
    """The viewer, and beside it one that saves what it shows, if there is a path to save it to."""
    if path is None:
        return viewer
    from nlos_cam.view.rrd_file import SavedView

    return Viewers([viewer, SavedView(path, bench.rig, bench.measured)])
