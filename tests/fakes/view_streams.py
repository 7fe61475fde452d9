"""What a view's server serves in tests: two files and a stream that lasts; and how a browser asks for them."""

from http.client import HTTPConnection, HTTPResponse
from threading import Event
from urllib.parse import urlsplit

from nlos_cam.view.server import Send

EVERYWHERE = "0.0.0.0"  # noqa: S104  on purpose: what it exposes is tested
ASSETS = {"/": ("text/html", b"<p>page</p>"), "/file.wasm": ("application/wasm", bytes(5_000_000))}


def ask(address: str, path: str, *, method: str = "GET", host: str | None = None) -> HTTPResponse:
    connection = HTTPConnection(urlsplit(address).netloc, timeout=10.0)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


class Streams:
    """Sends a count every 10 ms until told to end; notes how each stream ended."""

    def __init__(self) -> None:
        self.end, self.ended = Event(), Event()
        self.error: OSError | None = None

    def __call__(self, send: Send) -> None:
        try:
            while not self.end.wait(0.01):
                send(b"x" * 1000)
        except OSError as error:
            self.error = error
            raise
        finally:
            self.ended.set()
