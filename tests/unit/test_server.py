from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection, HTTPResponse
from threading import Event
from urllib.parse import urlsplit

import pytest

from nlos_cam.view.assets import LOOPBACK
from nlos_cam.view.server import Send, ViewServer

ASSETS = {"/": ("text/html", b"<p>page</p>"), "/file.wasm": ("application/wasm", bytes(5_000_000))}


def ask(address: str, path: str) -> HTTPResponse:
    connection = HTTPConnection(urlsplit(address).netloc, timeout=10.0)
    connection.request("GET", path)
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


@pytest.fixture
def streams() -> Streams:
    return Streams()


@pytest.fixture
def server(streams: Streams) -> Iterator[ViewServer]:
    server = ViewServer(ASSETS, streams, 0)
    yield server
    streams.end.set()
    server.close()


def test_files_come_whole_with_their_type_and_nothing_may_come_from_elsewhere(server: ViewServer) -> None:
    for path, (kind, content) in ASSETS.items():
        with closing(ask(server.address, path + "?renderer=webgl")) as answer:
            assert answer.status == 200
            assert answer.headers["Content-Type"] == kind
            assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
            assert answer.read() == content


def test_an_unknown_path_is_not_found(server: ViewServer) -> None:
    with closing(ask(server.address, "/../secret")) as answer:
        assert answer.status == 404


def test_the_server_listens_on_the_loopback_only(server: ViewServer) -> None:
    assert urlsplit(server.address).hostname == LOOPBACK
    assert server._server.server_address[0] == LOOPBACK


def test_a_stream_lasts_until_it_is_ended(server: ViewServer, streams: Streams) -> None:
    with closing(ask(server.address, "/live.rrd")) as answer:
        assert answer.read(5000) == b"x" * 5000
        streams.end.set()
        assert set(answer.read()) <= {ord("x")}
    assert streams.error is None


def test_a_browser_that_leaves_ends_its_stream(server: ViewServer, streams: Streams) -> None:
    connection = HTTPConnection(urlsplit(server.address).netloc, timeout=10.0)
    connection.request("GET", "/live.rrd")
    answer = connection.getresponse()
    answer.read(10)
    answer.close()
    connection.close()
    assert streams.ended.wait(10.0)
    assert isinstance(streams.error, OSError)


def test_a_busy_port_is_not_fought_over(server: ViewServer, streams: Streams) -> None:
    busy = urlsplit(server.address).port
    other = ViewServer(ASSETS, streams, busy or 0)
    try:
        assert other.address != server.address
        with closing(ask(other.address, "/")) as answer:
            assert answer.status == 200
    finally:
        other.close()
