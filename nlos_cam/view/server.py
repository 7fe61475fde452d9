"""A web server on the loopback: fixed files, and one endless stream per browser."""

from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

from nlos_cam.view.assets import LOOPBACK, Assets

Send = Callable[[bytes], None]
STREAM_PATH = "/live.rrd"
WRITE_TIMEOUT_S = 5.0
"""A browser that takes no data for this long is let go."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; worker-src 'self' blob:"
)
"""The browser itself refuses to fetch anything from elsewhere."""


class ViewServer:
    """Serves from the moment it is made until `close`; takes the preferred port, or any free one if that is busy."""

    def __init__(self, assets: Assets, stream: Callable[[Send], None], preferred_port: int) -> None:
        handler = _handler(assets, stream)
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, preferred_port), handler)
        except OSError:
            self._server = ThreadingHTTPServer((LOOPBACK, 0), handler)
        self._server.daemon_threads = False  # so that closing waits for them
        self._thread = Thread(target=self._server.serve_forever, args=(0.1,), name="view server")
        self._thread.start()

    @property
    def address(self) -> str:
        return f"http://{LOOPBACK}:{self._server.server_address[1]}/"

    def close(self) -> None:
        """Stop listening and wait for the answers under way: the streams must have been told to end."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def _handler(assets: Assets, stream: Callable[[Send], None]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = WRITE_TIMEOUT_S

        def do_GET(self) -> None:
            try:
                self._answer(self.path.partition("?")[0])
            except OSError:
                self.close_connection = True  # the browser left, which is its right

        def _answer(self, path: str) -> None:
            if path == STREAM_PATH:
                self._begin("application/octet-stream")
                stream(self._send)
            elif path in assets:
                kind, content = assets[path]
                self._begin(kind, len(content))
                self._send(content)
            else:
                self.send_error(404)

        def _begin(self, kind: str, length: int | None = None) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Security-Policy", POLICY)
            self.send_header("Cache-Control", "no-store")
            if length is not None:
                self.send_header("Content-Length", str(length))
            self.end_headers()

        def _send(self, content: bytes) -> None:
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name http.server uses
            pass

    return Handler
