"""Live view, and view of a recording or a saved session, in a browser, through a web server on the
loopback.
"""

import secrets
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Condition, Event, Lock, Thread
from typing import NamedTuple, Self

from nlos_calibration import MeasuredWall, Rig

from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.threads import LatestValue
from nlos_cam.view.messages import MomentPacker, bench_message, pack
from nlos_cam.view.server import LOOPBACK, POLICY, SANDBOX, Assets, Send, Served, ViewServer
from nlos_cam.view.session_file import Chunks, page_html
from nlos_cam.view.session_mark import SESSION_MARK
from nlos_cam.view.viewer import Controls, Moment

PREFERRED_PORT = 9090
PERIOD_S = 1 / 12
"""Seconds between moments sent."""
PATIENCE_S = 0.05
"""Seconds to wait for the next moment: packing that begins with a moment ends before the loop's
next frame.
"""
STATUS_S = 0.5
"""Seconds between messages of the status, also without moments."""
ENDED = pack({"kind": "status", "state": "ended"})
HTML = "text/html; charset=utf-8"


class Packet(NamedTuple):
    """Newest messages, each with its number; 0 for none."""

    bench: tuple[int, bytes] = (0, b"")
    moment: tuple[int, bytes] = (0, b"")
    status: tuple[int, bytes] = (0, b"")


class Website:
    """Page with a stream and commands, served while entered.

    `controls` gives the status and runs commands, which need the token in the printed address.
    """

    mode = "live"
    policy = POLICY

    def __init__(
        self, *, host: str = LOOPBACK, port: int | None = None, controls: Controls | None = None
    ) -> None:
        """Prepare a server at `port`, or without one at 9090 or the next free port."""
        self.address: str | None = None
        self._host = host
        self._port = port
        self._controls = controls
        self._token = secrets.token_urlsafe(12)
        self._hello = pack({"kind": "hello", "mode": self.mode, "run": secrets.token_hex(8)})

    def __enter__(self) -> Self:
        port = PREFERRED_PORT if self._port is None else self._port
        served = Served(self._assets(), self._stream, token=self._token, policy=self.policy)
        command = self._controls
        if command:
            served = replace(served, command=command.run, file=command.file)
        self._server = ViewServer(served, port, host=self._host, exact=self._port is not None)
        self.address = self._server.address + (f"#{self._token}" if command else "")
        return self

    def __exit__(self, *_: object) -> None:
        self._server.close()

    def _assets(self) -> Assets:
        return {"/": (HTML, page_html(self.mode).encode())}

    def _stream(self, send: Send) -> None:
        raise NotImplementedError

    def _status(self) -> bytes:
        status = self._controls.status() if self._controls else {"state": "running"}
        return pack({"kind": "status", "controls": self._controls is not None, **status})


class WebViewer(Website):
    """Live view. A thread of its own packs the newest moment once for all browsers, and only if
    there is one.
    """

    def __init__(
        self,
        rig: Rig | None = None,
        measured: MeasuredWall | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        host: str = LOOPBACK,
        port: int | None = None,
        controls: Controls | None = None,
        on_thread: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepare the view; without a rig it shows the status until `begin`. `on_thread` is called
        as threads work.
        """
        super().__init__(host=host, port=port, controls=controls)
        self._on_thread = on_thread
        self._clock = clock
        self._moments = LatestValue[Moment]()
        self._packets = LatestValue[Packet]()
        self._closed = Event()
        self._watching = 0
        self._lock = Lock()
        self._bench: tuple[int, bytes] = (0, b"")
        self._packer: MomentPacker | None = None
        self._thread = Thread(target=self._pack_all, name="view")
        if rig:
            self.begin(rig, measured)

    def begin(self, rig: Rig, measured: MeasuredWall | None = None) -> None:
        """Show this bench from now on."""
        self._bench = (self._bench[0] + 1, bench_message(rig, measured))
        self._packer = MomentPacker()

    def __enter__(self) -> Self:
        super().__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._moments.close()
        self._thread.join()
        self._packets.close()
        super().__exit__()

    def show(self, moment: Moment) -> None:
        """Replace the newest moment; one that was not sent is skipped."""
        self._moments.put(moment)

    def _pack_all(self) -> None:
        """Pack the newest moment and the status, PERIOD_S apart, while any browser watches."""
        seen = 0
        status_s = float("-inf")
        moment = status = (0, b"")
        while not self._closed.is_set():
            self._on_thread()
            start_s = self._clock()
            newest = self._moments.fresh(seen, PATIENCE_S, STATUS_S)
            if newest is None and seen > moment[0]:
                newest = self._moments.after(seen - 1, 0.0)  # the last one, when nobody watched
            if newest is not None:
                seen = newest[0]
            if self._watching == 0:
                continue

            if newest is not None and self._packer:
                moment = seen, self._packer.pack(newest[1])
            if newest is None or start_s - status_s >= STATUS_S:
                status_s = start_s
                status = status[0] + 1, self._status()
            self._packets.put(Packet(self._bench, moment, status))
            self._closed.wait(max(0.0, start_s + PERIOD_S - self._clock()))

    def _stream(self, send: Send) -> None:
        """Send to one browser until it leaves (`send` raises OSError) or the viewer closes.

        While a slow browser blocks `send`, it skips moments, and memory stays constant.
        """
        with self._lock:
            self._watching += 1
        try:
            send(self._hello)
            sent = Packet()
            count = 0
            while not self._closed.is_set():
                self._on_thread()
                newest = self._packets.after(count, STATUS_S)
                if newest is None:
                    continue
                count, packet = newest
                pairs = zip(packet, sent, strict=True)
                send(b"".join(new[1] for new, old in pairs if new[0] != old[0]))
                sent = packet
            send(ENDED)
        finally:
            with self._lock:
                self._watching -= 1


class PlaybackViewer(Website):
    """View of a recording while it is reconstructed: every moment stays, and the page plays, pauses
    and scrubs.

    The moments are kept in a temporary file. `show` must get them all, in order; `finish` when
    there are no more.
    """

    mode = "recorded"

    def __init__(
        self,
        rig: Rig,
        measured: MeasuredWall | None = None,
        *,
        host: str = LOOPBACK,
        port: int | None = None,
        controls: Controls | None = None,
    ) -> None:
        super().__init__(host=host, port=port, controls=controls)
        self._bench = bench_message(rig, measured)
        self._chunks = Chunks(MomentPacker())
        self._changed = Condition()
        self._closed = False
        self._ends = [0]
        """End of each chunk in the file, after a zero."""

    def __enter__(self) -> Self:
        self._file = tempfile.TemporaryFile()
        return super().__enter__()

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        super().__exit__()
        self._file.close()

    def show(self, moment: Moment) -> None:
        self._keep(self._chunks.add(moment))

    def finish(self) -> None:
        """Keep the last moments, which do not fill a chunk."""
        self._keep(self._chunks.rest())

    def _keep(self, chunk: bytes | None) -> None:
        if chunk is not None:
            with self._changed:
                try:
                    self._file.seek(self._ends[-1])
                    self._file.write(chunk)
                except OSError as error:
                    raise DiskFullError(
                        f"{tempfile.gettempdir()} takes no more of the view ({error.strerror}):"
                        " free some space there, or name another folder in TMPDIR"
                    ) from error
                self._ends.append(self._ends[-1] + len(chunk))
                self._changed.notify_all()

    def _stream(self, send: Send) -> None:
        send(self._hello + self._bench)
        due_s = time.monotonic()
        for chunk in self._kept():
            if chunk:
                send(chunk)
            # Chunks may come one after another for as long as the recording is reconstructed.
            if not chunk or time.monotonic() >= due_s:
                send(self._status())
                due_s = time.monotonic() + STATUS_S
        send(ENDED)

    def _kept(self) -> Iterator[bytes]:
        """Yield the chunks as they come, and nothing every STATUS_S while none comes, until the
        view closes.
        """
        sent = 0
        while not self._closed:
            with self._changed:
                if len(self._ends) == sent + 1:
                    self._changed.wait(STATUS_S)
                chunk = b""
                if len(self._ends) > sent + 1 and not self._closed:
                    self._file.seek(self._ends[sent])
                    chunk = self._file.read(self._ends[sent + 1] - self._ends[sent])
                    sent = sent + 1
            yield chunk


SESSION = "session"
"""Mode of the page of a saved session."""
NO_STORAGE = b"""<script>
Object.defineProperty(window, "sessionStorage", { value: { getItem: () => null, setItem() {}, removeItem() {} } });
</script>
"""
"""What the page finds in place of its storage, which a sandbox refuses with an error."""


class RecordedView(Website):
    """View of a session saved as one HTML file, served while entered. Raises RecordingError for
    another file.

    Its scripts are the file's, and its address may have been a live run's, or become one's: they
    run in a sandbox.
    """

    mode = "recorded"
    policy = SANDBOX

    def __init__(self, path: Path, *, host: str = LOOPBACK, port: int | None = None) -> None:
        super().__init__(host=host, port=port)
        try:
            with path.open("rb") as file:  # of any size: the mark first
                start = file.read(1000)
                content = start + file.read() if SESSION_MARK in start else b""
        except OSError as error:
            raise RecordingError(
                f"{path} cannot be read ({error.strerror}): name a saved session (.html)"
            ) from error
        if not content:
            raise RecordingError(
                f"{path} is no saved session: make one with `live --save-view` or `replay"
                " --save-view`"
            )
        self._content = content.replace(b"<script", NO_STORAGE + b"<script", 1)

    def _assets(self) -> Assets:
        return {"/": (HTML, self._content)}

    def _stream(self, send: Send) -> None:
        """Send the kind of page alone: the file holds the rest. A page of another run that asks here
        loads this one.
        """
        send(pack({"kind": "hello", "mode": SESSION}))
