"""What a view's server serves in tests: two files and a stream that lasts; and how a browser asks
for them.
"""

import base64
import zlib
from collections.abc import Iterator, Sequence
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from threading import Event
from typing import Any
from urllib.parse import urlsplit

from nlos_cam.view.messages import HEAD, unpack
from nlos_cam.view.server import Send

EVERYWHERE = "0.0.0.0"  # noqa: S104  on purpose: what it exposes is tested
ASSETS = {"/": ("text/html", b"<p>page</p>"), "/file.wasm": ("application/wasm", bytes(5_000_000))}


def ask(
    address: str, path: str, *, method: str = "GET", host: str | None = None, **headers: str
) -> HTTPResponse:
    """Send a request; underscores in the names of further headers are hyphens, and `body` is its
    body.
    """
    parts = urlsplit(address)
    connection = HTTPConnection(parts.netloc, timeout=10.0)
    body = headers.pop("body", None)
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, sent if host is None else {"Host": host, **sent})
    return connection.getresponse()


def messages_in(stream: bytes) -> Sequence[bytes]:
    """Return the whole messages of a stream; a cut last one is left out."""
    found = list[bytes]()
    at = 0
    while at + HEAD.size <= len(stream):
        end = at + 4 + HEAD.unpack_from(stream, at)[0]
        if end > len(stream):
            break
        found.append(stream[at:end])
        at = end
    return found


def messages_of(page: bytes) -> list[bytes]:
    """Return the messages in a saved session."""
    parts = page.split(b'<script type="text/x-message">')[1:]
    return [
        base64.b64decode(part.partition(b"</script>")[0]) for part in parts if b"</script>" in part
    ]


def messages(answer: HTTPResponse) -> Iterator[dict[str, Any]]:
    """Yield the messages of a stream, their fields and arrays in one."""
    received = b""
    while chunk := answer.read1():
        received += chunk
        for message in messages_in(received):
            received = received[len(message) :]
            fields, arrays = unpack(message)
            yield {**fields, "arrays": arrays}


def saved_moments(path: Path) -> list[dict[str, Any]]:
    """Return the moments of a saved session, without their arrays."""
    chunks = (unpack(message) for message in messages_of(path.read_bytes()))
    data = [
        zlib.decompress(arrays["data"].tobytes())
        for fields, arrays in chunks
        if fields["kind"] == "chunk"
    ]
    return [unpack(message)[0] for message in messages_in(b"".join(data))]


class Streams:
    """Sends a count every 10 ms until told to end; notes how each stream ended."""

    def __init__(self) -> None:
        self.end = Event()
        self.ended = Event()
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
