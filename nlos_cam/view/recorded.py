"""A saved view in a browser: the same page and server as the live one, and time to go back and forth in."""

import struct
from pathlib import Path
from typing import BinaryIO, Self

from nlos_cam.errors import RecordingError
from nlos_cam.view.assets import LOOPBACK, page_assets
from nlos_cam.view.rerun_viewer import PREFERRED_PORT
from nlos_cam.view.server import Send, ViewServer

MAGIC = b"RRF2"
"""What a file of this version of Rerun begins with."""
HEADER_BYTES, END = 12, 0
MESSAGE = struct.Struct("<QQ")
"""What each message begins with: its kind, and how many bytes follow. The kind END comes before what ends a file."""
CHUNK_BYTES = 1 << 18


class RecordedView:
    """Serves a file that a `SavedView` wrote while entered, up to where it is whole. Raises RecordingError."""

    def __init__(self, path: Path, *, host: str = LOOPBACK, port: int | None = None) -> None:
        """At this `port` or nowhere; without one, at 9090 or where there is room."""
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
    """How much of a saved view is whole messages: all of it, but for one whose writer was killed."""
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
