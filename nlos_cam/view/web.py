"""Live view and saved view in a browser, through a web server on the loopback."""

import struct
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import BinaryIO, Self

from nlos_calibration import MeasuredWall, Rig

from nlos_cam.errors import RecordingError
from nlos_cam.threads import LatestValue
from nlos_cam.view.assets import LOOPBACK, page_assets
from nlos_cam.view.drawing import Drawing, new_recording
from nlos_cam.view.server import Send, ViewServer
from nlos_cam.view.viewer import Moment

PREFERRED_PORT = 9090
DRAW_PERIOD_S = 1 / 12
LIDAR_EVERY = 2
"""Lidar pictures, which are large, go out with every second drawing."""
PATIENCE_S = 0.05
"""Seconds to wait for the next moment: drawing that begins with a moment ends before the loop's next frame."""
WAIT_S = 0.5


class WebViewer:
    """Live view, served while entered; each browser's thread draws for it, so that no browser costs nothing."""

    def __init__(
        self,
        rig: Rig,
        measured: MeasuredWall | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        host: str = LOOPBACK,
        port: int | None = None,
        on_stream_thread: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepare a server at `port`, or without one at 9090 or the next free port.

        `on_stream_thread` is called once in each browser's thread before it draws.
        """
        self._on_stream_thread = on_stream_thread
        self.address: str | None = None
        self._host, self._port = host, port
        self._rig, self._measured, self._clock = rig, measured, clock
        self._moments = LatestValue[Moment]()
        self._closed = Event()

    def __enter__(self) -> Self:
        port = PREFERRED_PORT if self._port is None else self._port
        self._server = ViewServer(page_assets(), self._stream, port, host=self._host, exact=self._port is not None)
        self.address = self._server.address
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._moments.close()
        self._server.close()

    def show(self, moment: Moment) -> None:
        """Replace the newest moment; an undrawn one is skipped."""
        self._moments.put(moment)

    def _stream(self, send: Send) -> None:
        """Draw for one browser until it leaves (`send` raises OSError) or the viewer closes.

        While a slow browser blocks `send`, nothing is drawn for it: it skips moments and memory stays constant.
        """
        self._on_stream_thread()
        recording = new_recording()
        stream, drawing = recording.binary_stream(), None
        count = drawn = 0
        try:
            while not self._closed.is_set():
                start_s = self._clock()
                newest = self._moments.fresh(count, PATIENCE_S, WAIT_S)
                if newest is None:
                    continue
                count, moment = newest
                drawing = drawing or Drawing(recording, self._rig, moment, self._measured)
                drawing.draw(moment, with_lidar=drawn % LIDAR_EVERY == 0)
                send(stream.read() or b"")
                drawn += 1
                self._closed.wait(max(0.0, start_s + DRAW_PERIOD_S - self._clock()))
        finally:
            recording.disconnect()


MAGIC = b"RRF2"
"""First bytes of a file of this Rerun version."""
HEADER_BYTES, END = 12, 0
MESSAGE = struct.Struct("<QQ")
"""Head of each message: its kind and number of bytes. The kind END precedes the end of a file."""
CHUNK_BYTES = 1 << 18


class RecordedView:
    """Saved view of an `RrdFile`, served while entered, up to its last whole message. Raises RecordingError."""

    def __init__(self, path: Path, *, host: str = LOOPBACK, port: int | None = None) -> None:
        """Prepare a server at `port`, or without one at 9090 or the next free port."""
        self.address: str | None = None
        self._path, self._host, self._port = path, host, port
        try:
            with path.open("rb") as file:
                begins = file.read(len(MAGIC))
        except OSError as error:
            raise RecordingError(f"{path} cannot be read ({error.strerror}): name a saved view (.rrd)") from error
        if begins != MAGIC:
            raise RecordingError(f"{path} is no saved view: make one with `live --save-view` or `replay --save-view`")

    def __enter__(self) -> Self:
        assets, port = page_assets(recorded=True), PREFERRED_PORT if self._port is None else self._port
        self._server = ViewServer(assets, self._stream, port, host=self._host, exact=self._port is not None)
        self.address = self._server.address
        return self

    def __exit__(self, *_: object) -> None:
        self._server.close()

    def _stream(self, send: Send) -> None:
        with self._path.open("rb") as file:
            left = whole_bytes(file)
            file.seek(0)
            while left and (chunk := file.read(min(left, CHUNK_BYTES))):
                send(chunk)
                left -= len(chunk)


def whole_bytes(file: BinaryIO) -> int:
    """Return the number of bytes in whole messages: all, unless the writer was killed."""
    size, end = file.seek(0, 2), HEADER_BYTES
    while end + MESSAGE.size <= size:
        file.seek(end)
        kind, length = MESSAGE.unpack(file.read(MESSAGE.size))
        if end + MESSAGE.size + length > size:
            break
        if kind == END:
            return size
        end += MESSAGE.size + length
    return min(end, size)
