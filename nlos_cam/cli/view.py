"""`nlos-cam view`, and what `live` and `replay` share with it: a saved view is looked at again.

Where `nlos-cam live` shows its view, and what it tells of that.
"""

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated, Protocol
from urllib.parse import urlsplit

import typer

from nlos_cam.cli.common import INTERRUPTED, Json, finish, interrupted_by_signals, say, stop_on_signals
from nlos_cam.live import yield_to_loop
from nlos_cam.reconstruct import CalibratedRig
from nlos_cam.view import LOOPBACK, NullViewer, Viewer, Viewers, exposed

NoView = Annotated[bool, typer.Option("--no-view", help="Serve no live view.")]
ViewPort = Annotated[
    int | None, typer.Option("--view-port", min=1, max=65535, help="Serve the view here or nowhere; else 9090 or near.")
]
ViewHost = Annotated[
    str | None,
    typer.Option("--view-host", help="Serve the view to others, at this address of this machine (0.0.0.0: all)."),
]
Open = Annotated[bool, typer.Option("--open", help="Open the view in the default browser.")]
DESKTOPS = "DISPLAY", "WAYLAND_DISPLAY", "BROWSER"


def viewer_of(bench: CalibratedRig, *, no_view: bool, host: str | None = None, port: int | None = None) -> Viewer:
    """What shows a live run. Raises typer.BadParameter where none is wanted and yet a place for it is named."""
    if no_view:
        if host is not None or port is not None:
            raise typer.BadParameter("--view-host and --view-port say where the view is: leave --no-view away")
        return NullViewer()
    from nlos_cam.view import WebViewer

    return WebViewer(bench.rig, bench.measured, host=host or LOOPBACK, port=port, on_stream_thread=yield_to_loop)


class Addressed(Protocol):
    """What a browser can find: a live view, or a saved one."""

    @property
    def address(self) -> str | None: ...


def tell_of_view(
    viewer: Addressed, *, host: str | None, port: int | None, open_it: bool, what: str = "live view"
) -> None:
    """Say where the view is, who else can see it, and open it if that is wanted."""
    if not viewer.address:
        say("running without a view (Ctrl-C ends it)")
        return
    from nlos_cam.view import PREFERRED_PORT

    taken = port is None and urlsplit(viewer.address).port != PREFERRED_PORT
    say(f"{what}: {viewer.address}  (Ctrl-C ends it{f'; port {PREFERRED_PORT} is taken' if taken else ''})")
    if host and (told := exposed(host, urlsplit(viewer.address).port or 0)):
        say(f"[yellow]note:[/] {told}", marked=True)
    if open_it and not opened_in_browser(viewer.address):
        say(f"note: no browser could be opened here: open {viewer.address} in one")


def opened_in_browser(address: str) -> bool:
    """Open an address in the default browser, in a window: one for terminals would take this one over."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in DESKTOPS):
        return False
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


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
    from nlos_cam.view import RecordedView

    with interrupted_by_signals():
        recorded = RecordedView(file, host=view_host or LOOPBACK, port=view_port)
    with stop_on_signals() as stop, recorded:
        tell_of_view(recorded, host=view_host, port=view_port, open_it=open_view, what="saved view")
        address = recorded.address
        stop.wait(seconds)
    finish({"file": str(file), "address": address}, as_json=json, text=f"{file} was at {address}")
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def saving(viewer: Viewer, bench: CalibratedRig, path: Path | None) -> Viewer:
    """The viewer, and beside it one that saves what it shows, if there is a path to save it to."""
    if path is None:
        return viewer
    from nlos_cam.view import RrdFile

    return Viewers([viewer, RrdFile(path, bench.rig, bench.measured)])
