"""The command `view`, and the view options that `live` and `replay` share with it."""

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
    int | None,
    typer.Option(
        "--view-port",
        min=1,
        max=65535,
        help="Port of the live view; fails if taken (default: 9090, or the next free port).",
    ),
]
ViewHost = Annotated[
    str | None,
    typer.Option("--view-host", help="Address to serve the view on for other machines (0.0.0.0: all)."),
]
Open = Annotated[bool, typer.Option("--open", help="Open the view in the default browser.")]
DESKTOPS = "DISPLAY", "WAYLAND_DISPLAY", "BROWSER"


def viewer_of(bench: CalibratedRig, *, no_view: bool, host: str | None = None, port: int | None = None) -> Viewer:
    """Return the viewer of a live run. Raises typer.BadParameter for a host or port together with --no-view."""
    if no_view:
        if host is not None or port is not None:
            raise typer.BadParameter("--view-host and --view-port need a view: drop --no-view")
        return NullViewer()
    from nlos_cam.view import WebViewer

    return WebViewer(bench.rig, bench.measured, host=host or LOOPBACK, port=port, on_stream_thread=yield_to_loop)


class Addressed(Protocol):
    """View with an address: live or saved."""

    @property
    def address(self) -> str | None: ...


def announce_view(
    viewer: Addressed, *, host: str | None, port: int | None, open_it: bool, what: str = "live view"
) -> None:
    """Print the view's address and who else can see it, and open it on request."""
    if not viewer.address:
        say("Running without a view. Press Ctrl-C to stop.")
        return
    from nlos_cam.view import PREFERRED_PORT

    taken = port is None and urlsplit(viewer.address).port != PREFERRED_PORT
    note = f" Port {PREFERRED_PORT} is taken." if taken else ""
    say(f"{what}: {viewer.address}  Press Ctrl-C to stop.{note}")
    if host and (note := exposed(host, urlsplit(viewer.address).port or 0)):
        say(f"[yellow]note:[/] {note}", marked=True)
    if open_it and not opened_in_browser(viewer.address):
        say(f"note: no browser could be opened: open {viewer.address} yourself")


def opened_in_browser(address: str) -> bool:
    """Open an address in the default browser; return False without a desktop, where a text browser would open."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in DESKTOPS):
        return False
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


SUFFIX = ".rrd"
SaveView = Annotated[
    Path | None, typer.Option("--save-view", help="Save the view to this .rrd file, for `nlos-cam view`.")
]
SaveReplayView = Annotated[
    bool, typer.Option("--save-view", help="Save the view to DIR/view.rrd, for `nlos-cam view`.")
]
Stills = Annotated[int, typer.Option("--stills", min=0, max=100, help="Number of still pictures to write (PNG).")]
Video = Annotated[bool, typer.Option("--video", help="Write a video, DIR/replay.webm.")]
ViewFile = Annotated[Path, typer.Argument(metavar="F.RRD", help="File written by --save-view.")]
Seconds = Annotated[
    float | None, typer.Option("--seconds", min=0.1, help="Stop after this many seconds (default: run until Ctrl-C).")
]


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
    """Open a saved view in a browser, with play, pause and scrubbing."""
    from nlos_cam.view import RecordedView

    with interrupted_by_signals():
        recorded = RecordedView(file, host=view_host or LOOPBACK, port=view_port)
    with stop_on_signals() as stop, recorded:
        announce_view(recorded, host=view_host, port=view_port, open_it=open_view, what="saved view")
        address = recorded.address
        stop.wait(seconds)
    finish({"file": str(file), "address": address}, as_json=json, text=f"{file} was at {address}")
    if stop.is_set():
        raise typer.Exit(INTERRUPTED)


def saving(viewer: Viewer, bench: CalibratedRig, path: Path | None) -> Viewer:
    """Return the viewer, joined by one that saves to `path` if given."""
    if path is None:
        return viewer
    from nlos_cam.view import RrdFile

    return Viewers([viewer, RrdFile(path, bench.rig, bench.measured)])
