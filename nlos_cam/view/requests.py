"""What the view's server answers to a request: a file, the stream, or why not."""

from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from threading import BoundedSemaphore

from nlos_cam.view.assets import Assets

Send = Callable[[bytes], None]
STREAM_PATH = "/live.rrd"
WRITE_TIMEOUT_S = 5.0
"""A browser that takes no data, or gives no request, for this long is let go."""
PIECE_BYTES = 1 << 18
"""A file goes out in pieces, each within that time: the viewer has 30 MB, and a link may be slow."""
MOST_STREAMS = 8
"""Browsers that watch at once; each costs a drawing, 12 times a second."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; worker-src 'self' blob:; frame-ancestors 'self'"
)
"""The browser itself refuses to fetch anything from elsewhere, or to show the view inside another's page."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}


@dataclass(frozen=True)
class Served:
    """What a server gives to whoever asks by a `known` name."""

    assets: Assets
    stream: Callable[[Send], None]
    known: Callable[[str], bool]
    most_streams: int
    streams: BoundedSemaphore


class Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD; whatever else is asked is not implemented."""

    served: Served
    timeout = WRITE_TIMEOUT_S
    server_version, sys_version = "nlos-cam", ""

    def do_GET(self) -> None:
        try:
            self._answer(self.path.partition("?")[0])
        except OSError:
            self.close_connection = True  # the browser left, which is its right

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, path: str) -> None:
        if not self.served.known(self.headers.get("Host", "")):
            self._tell(HTTPStatus.FORBIDDEN, "this is not the name of the machine: open the address as it was told")
        elif path == STREAM_PATH:
            self._answer_stream()
        elif path in self.served.assets:
            kind, content = self.served.assets[path]
            self._begin(HTTPStatus.OK, kind, len(content))
            self._send(content)
        else:
            self._tell(HTTPStatus.NOT_FOUND, "there is nothing here: the view is at /")

    def _answer_stream(self) -> None:
        if not self.served.streams.acquire(blocking=False):
            told = f"{self.served.most_streams} browsers watch already, and no more may: close one, and reload"
            self._tell(HTTPStatus.SERVICE_UNAVAILABLE, told)
            return
        try:
            self._begin(HTTPStatus.OK, "application/octet-stream")
            if self.command != "HEAD":
                self.served.stream(self._send)
        finally:
            self.served.streams.release()

    def _tell(self, status: HTTPStatus, text: str) -> None:
        content = f"{text}\n".encode()
        self._begin(status, "text/plain; charset=utf-8", len(content))
        self._send(content)

    def _begin(self, status: HTTPStatus, kind: str, length: int | None = None) -> None:
        self.send_response(status)
        told = {"Content-Type": kind, **HEADERS}
        if length is not None:
            told["Content-Length"] = str(length)
        for name, value in told.items():
            self.send_header(name, value)
        self.end_headers()

    def _send(self, content: bytes) -> None:
        if self.command == "HEAD":
            return
        for start in range(0, len(content), PIECE_BYTES):
            self.wfile.write(content[start : start + PIECE_BYTES])

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name http.server uses
        pass


def handler_of(
    assets: Assets, stream: Callable[[Send], None], known: Callable[[str], bool], most_streams: int
) -> type[Handler]:
    """A handler for requests whose Host header is `known`; at most so many streams are given at once."""
    served = Served(assets, stream, known, most_streams, BoundedSemaphore(most_streams))
    return type("ViewHandler", (Handler,), {"served": served})
