"""The command `view`, and the view options that `live` and `replay` share with it."""

from __future__ import annotations

import os
import shlex
import sys
import webbrowser
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Protocol
from urllib.parse import urlsplit

import typer
from rich.markup import escape

from nlos_cam import camera as cameras
from nlos_cam import live as loop
from nlos_cam import reconstruct
from nlos_cam import recording as recordings
from nlos_cam import replay as replays
from nlos_cam import view as views
from nlos_cam.cli import benches
from nlos_cam.cli.common import (
    MAX_S,
    Json,
    exit_interrupted,
    finish,
    interrupted_by_signals,
    say,
    stop_on_signals,
)
from nlos_cam.errors import RecordingError

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
    typer.Option(
        "--view-host", help="Address to serve the view on for other machines (0.0.0.0: all)."
    ),
]
Open = Annotated[bool, typer.Option("--open", help="Open the view in the default browser.")]
DESKTOPS = "DISPLAY", "WAYLAND_DISPLAY", "BROWSER"


def viewer_of(
    control: loop.RunControl, *, no_view: bool, host: str | None = None, port: int | None = None
) -> views.NullViewer | views.WebViewer:
    """Return the viewer of a live run. Raises typer.BadParameter for a host or port together with
    --no-view.
    """
    if no_view:
        if host is not None or port is not None:
            raise typer.BadParameter("--view-host and --view-port need a view: drop --no-view")
        return views.NullViewer()
    # An ordinary thread could be stopped while it holds Python's lock.
    control.thread_start = loop.yield_to_loop
    return views.WebViewer(
        host=host or views.LOOPBACK, port=port, controls=control, on_thread=loop.yield_to_loop
    )


def each_of(*functions: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Return one function of progress (done, total) that calls several."""

    def call(done: int, total: int) -> None:
        for function in functions:
            function(done, total)

    return call


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
    taken = port is None and urlsplit(viewer.address).port != views.PREFERRED_PORT
    note = f" Port {views.PREFERRED_PORT} is taken." if taken else ""
    say(f"{what}: {viewer.address}  Press Ctrl-C to stop.{note}")
    if host and (note := views.exposed(host, urlsplit(viewer.address).port or 0)):
        say(f"[yellow]note:[/] {note}", marked=True)
    if open_it and not opened_in_browser(viewer.address):
        say(f"note: no browser could be opened: open {viewer.address} yourself")


def opened_in_browser(address: str) -> bool:
    """Open an address in the default browser; return False without a desktop, where a text browser
    would open.
    """
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in DESKTOPS):
        return False
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


SaveView = Annotated[
    Path | None,
    typer.Option("--save-view", help="Save the view to this .html file, which any browser plays."),
]
SaveReplayView = Annotated[
    bool,
    typer.Option("--save-view", help="Save the view to DIR/view.html, which any browser plays."),
]
Stills = Annotated[
    int, typer.Option("--stills", min=0, max=100, help="Number of still pictures to write (PNG).")
]
Video = Annotated[bool, typer.Option("--video", help="Write a video, DIR/replay.webm.")]
ViewFile = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="Recording (.bag, or sample), or saved session (.html)."),
]
Wall = Annotated[
    Path | None, typer.Option("--wall", help="Wall record of the recording's bench (wall.toml).")
]
Seconds = Annotated[
    float | None,
    typer.Option(
        "--seconds", min=0.1, help="Stop after this many seconds (default: run until Ctrl-C)."
    ),
]
ViewSeconds = Annotated[
    float | None,
    typer.Option(
        "--seconds",
        min=0.1,
        max=MAX_S,
        help="Stop this many seconds after every frame is there (default: run until Ctrl-C).",
    ),
]


def view(
    file: ViewFile,
    wall: Wall = None,
    bench_folder: benches.BenchOrWeights = None,
    weights: benches.Weights = None,
    seconds: ViewSeconds = None,
    view_port: ViewPort = None,
    view_host: ViewHost = None,
    open_view: Open = False,
    json: Json = False,
) -> None:
    """Play a recording or a saved session in a browser: play, pause, scrub, change the speed,
    export.
    """
    host = view_host or views.LOOPBACK
    announce = partial(announce_view, host=view_host, port=view_port, open_it=open_view)
    if file.suffix in {".hdf5", ".h5"}:
        raise RecordingError(
            f"{file} is no recording: a transient is drawn by `nlos-cam info {shlex.quote(str(file))}"
            " --out look.html`"
        )
    is_recording = recordings.is_ros2(file) or cameras.full_uri(file).startswith("bag:")
    if not is_recording and (wall or bench_folder or weights):
        raise typer.BadParameter(
            "--wall, --bench and --weights are for a recording (.bag): a saved session holds its"
            " pictures"
        )
    chosen = benches.choose(bench_folder, wall, weights)
    if is_recording:
        with interrupted_by_signals():
            opened = cameras.open_camera(f"bag:{file}")
            bench = chosen.open(opened)
            found = chosen.load_networks(bench)
            networks = found.network, found.uncertainty_model
            playback = replays.Playback(opened, bench, networks, host=host, port=view_port)
        with stop_on_signals() as stop, playback:
            announce(playback, what="recording")
            playback.reconstruct(stop)
            stop.wait(seconds)
        address = playback.address
    else:
        recorded = views.RecordedView(file, host=host, port=view_port)
        with stop_on_signals() as stop, recorded:
            announce(recorded, what="saved view")
            address = recorded.address
            stop.wait(seconds)
    finish({"file": str(file), "address": address}, as_json=json, text=f"{file} was at {address}")
    if stop.is_set():
        exit_interrupted("the view is closed")


@contextmanager
def saving(
    viewer: views.Viewer, bench: reconstruct.CalibratedRig, path: Path | None
) -> Generator[views.Viewer]:
    """Yield an entered viewer, joined by one that saves the session to `path` if given.

    A file that cannot be opened is an error; one that ends early is a note, and the run goes on to
    its summary.
    """
    if path is None:
        yield viewer
        return
    entered = ExitStack()
    session = entered.enter_context(views.SessionFile(path, bench.rig, bench.measured))
    try:
        yield views.Viewers([viewer, session])
    finally:
        with suppress(Exception):  # whatever it was, `problem` says it
            entered.close()
        if session.problem:
            say(f"[yellow]warning:[/] {escape(session.problem)}", marked=True)
        elif session.left_out:
            say(f"note: {path} lacks {session.left_out} moments for which there was no time")
    if session.kept and not session.problem:
        say(f"Saved the view: open {path} in a browser")
