import gzip
import re
import socket
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from http.client import HTTPException
from typing import Any
from urllib.parse import urlsplit

import pytest
from view_streams import ASSETS, EVERYWHERE, Streams, ask

from nlos_cam.errors import NlosCamError
from nlos_cam.view.server import (
    LOOPBACK,
    Served,
    ViewServer,
    address_of,
    exposed,
    is_loopback,
    names_of,
    resolved,
)
from nlos_cam.view.session_file import page_html


@pytest.fixture
def streams() -> Streams:
    return Streams()


@pytest.fixture
def server(streams: Streams) -> Iterator[ViewServer]:
    server = ViewServer(Served(ASSETS, streams), 0)
    yield server
    streams.end.set()
    server.close()


def status_of(address: str, path: str, **options: Any) -> int:
    with closing(ask(address, path, **options)) as answer:
        return answer.status


def test_server_sends_whole_files_and_refuses_any_other_request(server: ViewServer) -> None:
    assert urlsplit(server.address).hostname == server._server.server_address[0] == LOOPBACK

    for path, (kind, content) in ASSETS.items():
        with closing(ask(server.address, path + "?renderer=webgl")) as answer:
            assert (answer.status, answer.headers["Content-Type"]) == (200, kind)
            assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
            assert answer.read() == content
        with closing(ask(server.address, path, method="HEAD")) as answer:
            assert (answer.status, int(answer.headers["Content-Length"])) == (200, len(content))
            assert answer.read() == b""

    assert (
        status_of(server.address, "/../secret")
        == status_of(server.address, "/", method="POST")
        == 404
    )
    assert {
        status_of(server.address, "/", method=name) for name in ("PUT", "DELETE", "OPTIONS")
    } == {501}


@pytest.mark.parametrize(
    ("accepted", "is_packed"),
    [("gzip, deflate, br", True), ("br;q=1, gzip;q=0.5", True), ("gzip;q=0.0", False), ("", False)],
)
def test_page_is_packed_for_browsers_that_take_it(accepted: str, is_packed: bool) -> None:
    page = page_html("live").encode()
    served = Served({"/": ("text/html", page)}, lambda _: None)
    with (
        closing(ViewServer(served, 0)) as server,
        closing(ask(server.address, "/", Accept_Encoding=accepted)) as answer,
    ):
        content = answer.read()

        assert len(content) == int(answer.headers["Content-Length"])
        assert answer.headers["Vary"] == "Accept-Encoding"
        assert answer.headers.get("Content-Encoding") == ("gzip" if is_packed else None)

    assert (gzip.decompress(content) if is_packed else content) == page
    assert len(content) <= 51_000 or not is_packed


def test_server_closes_connections_beyond_its_limit(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.view.server.MAX_CONNECTIONS", 1)
    with (
        closing(ViewServer(Served(ASSETS, streams), 0)) as server,
        closing(ask(server.address, "/stream")) as first,
    ):
        with pytest.raises((HTTPException, OSError)):
            ask(server.address, "/")
        assert first.read(2000) == b"x" * 2000
        streams.end.set()


def test_closing_server_cuts_browsers_that_do_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.server.CLOSE_AFTER_S", 0.01)
    server = ViewServer(
        Served(ASSETS, lambda send: [send(bytes(1 << 20)) for _ in range(1000)] and None), 0
    )
    place = urlsplit(server.address)
    with socket.create_connection((place.hostname, place.port)) as silent, socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect((place.hostname, place.port))
        deaf.sendall(b"GET /stream HTTP/1.0\r\nHost: localhost\r\n\r\n")
        assert deaf.recv(12) == b"HTTP/1.0 200"
        server.close()
        assert silent.recv(1) == b""


def test_server_replaces_a_busy_port_unless_it_is_exact(
    server: ViewServer, streams: Streams
) -> None:
    busy = urlsplit(server.address).port or 0
    with pytest.raises(NlosCamError, match=rf"http://127.0.0.1:{busy}/ .* --view-port"):
        ViewServer(Served(ASSETS, streams), busy, exact=True)
    with closing(ViewServer(Served(ASSETS, streams), busy)) as other:
        assert other.address != server.address
        assert status_of(other.address, "/") == 200


def test_server_on_all_addresses_refuses_other_names(streams: Streams) -> None:
    with closing(ViewServer(Served(ASSETS, streams), 0, host=EVERYWHERE)) as everywhere:
        assert urlsplit(everywhere.address).hostname == LOOPBACK
        for host, status in (("192.168.3.4:9090", 200), ("evil.example", 403)):
            assert status_of(everywhere.address, "/", host=host) == status


def test_server_refuses_hosts_that_are_not_this_machine(streams: Streams) -> None:
    with pytest.raises(NlosCamError, match=r"http://192.0.2.1:0/"):
        ViewServer(Served(ASSETS, streams), 0, host="192.0.2.1")
    for host in ("no such host", "." * 300):
        with pytest.raises(NlosCamError, match=re.escape(host)):
            resolved(host)


def test_stream_lasts_until_it_is_ended(server: ViewServer, streams: Streams) -> None:
    with closing(ask(server.address, "/stream")) as answer:
        assert answer.read(5000) == b"x" * 5000
        streams.end.set()
        assert set(answer.read()) <= {ord("x")}
    assert streams.error is None


def test_stream_ends_when_its_browser_leaves(server: ViewServer, streams: Streams) -> None:
    with closing(ask(server.address, "/stream")) as answer:
        answer.read(10)

    assert streams.ended.wait(60.0)
    assert isinstance(streams.error, OSError)


@pytest.mark.parametrize("path", ["/", "/file.wasm"])
def test_server_answers_to_loopback_names_only(server: ViewServer, path: str) -> None:
    for host in ("127.0.0.1", "localhost:80", "LOCALHOST:8000", "[::1]:9090"):
        assert status_of(server.address, path, host=host) == 200
    for host in ("evil.example", "localhost:x.evil.example", "[::1].evil.com", "10.1.2.3", ""):
        with closing(ask(server.address, path, host=host)) as answer:
            assert answer.status == status_of(server.address, "/stream", host=host) == 403
            assert answer.read() != ASSETS[path][1]


def test_server_limits_streams_and_reuses_their_room(streams: Streams) -> None:
    server = ViewServer(Served(ASSETS, streams, max_streams=2), 0)
    watching = [ask(server.address, "/stream") for _ in range(2)]
    with closing(ask(server.address, "/stream")) as refused:
        assert refused.status == 503
        assert b"2 browsers" in refused.read()

    assert status_of(server.address, "/") == 200

    streams.end.set()
    for answer in watching:
        answer.read()
        answer.close()
    streams.end.clear()
    while (
        status_of(server.address, "/stream") != 200
    ):  # a stream's thread ends after the browser has seen its end
        pass
    streams.end.set()
    server.close()


def test_names_of_a_host_are_this_machines() -> None:
    is_known = names_of("bench.lan", "192.0.2.7")
    known = ("BENCH.lan:9090", "192.0.2.7:9090", "[fe80::1]:1", "localhost", socket.gethostname())
    unknown = ("evil.example", "bench.lan.evil.example", "")

    assert [is_known(name) for name in (*known, *unknown)] == [True] * 5 + [False] * 3
    assert not names_of("127.0.0.1", "127.0.0.1")(socket.gethostname() + ".evil.example")


@pytest.mark.parametrize(
    ("host", "address"), [("127.0.0.2", "127.0.0.2"), ("bench.lan", "127.0.1.1")]
)
def test_names_of_a_loopback_host_are_itself_alone(host: str, address: str) -> None:
    is_known = names_of(host, address)

    assert all(is_known(name) for name in (f"{host.upper()}:9090", f"{address}:1", "localhost"))
    assert not any(is_known(name) for name in ("evil.example", f"{host}.evil.example", "10.0.0.1"))
    assert not names_of("", address)("")


def test_loopback_is_told_from_hosts_that_others_can_reach() -> None:
    for host, loopback in (("127.0.0.1", True), ("localhost", True), (EVERYWHERE, False)):
        family, address = resolved(host)
        assert family in {socket.AF_INET, socket.AF_INET6}
        assert is_loopback(address) == loopback
        assert ("9090" in exposed(host, 9090)) == bool(exposed(host, 9090)) == (not loopback)
    for host in ("127.0.0.1", EVERYWHERE):
        assert address_of(host, 7) == "http://127.0.0.1:7/"

    assert address_of("::", 7) == address_of("::1", 7) == "http://[::1]:7/"

    note = exposed("192.0.2.7", 8000)

    assert all(text in note for text in ("192.0.2.7", "8000", "password"))
    assert "\n" not in note


CROSS_SITE = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "cors"}


@pytest.mark.parametrize(
    "headers", [CROSS_SITE, {"Origin": "http://evil.example"}, {"Origin": "null"}]
)
def test_server_refuses_pages_of_other_sites(server: ViewServer, headers: dict[str, str]) -> None:
    for path in ("/stream", "/file.wasm"):
        assert status_of(server.address, path, **headers) == 403
    followed = status_of(
        server.address, "/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate"
    )

    assert followed == 200, "a person may follow a link to the page"


def commanded(name: str, arguments: Mapping[str, Any]) -> str:
    if name == "fail":
        raise NlosCamError("no disk: free some space")
    return f"{name} {dict(arguments)}"


@pytest.mark.parametrize(
    ("body", "headers", "status", "text"),
    [
        ('{"command": "record", "label": "cup"}', {}, 200, "record {'label': 'cup'}"),
        ('{"command": "fail"}', {}, 409, "no disk: free some space"),
        ('{"command": "record"}', {"X_Token": "guessed"}, 403, "read-only"),
        ('{"command": "record"}', {"Origin": "http://evil.example"}, 403, "another site"),
        ("[1]", {}, 400, "not a command"),
        ("[" * 9000, {}, 400, "not a command"),
        ('{"label": "cup"}', {}, 400, "not a command"),
    ],
)
def test_command_needs_the_token_and_answers_in_words(
    streams: Streams, body: str, headers: dict[str, str], status: int, text: str
) -> None:
    headers = {"X_Token": "secret", **headers}
    with (
        closing(ViewServer(Served(ASSETS, streams, commanded, "secret"), 0)) as server,
        closing(ask(server.address, "/command", method="POST", body=body, **headers)) as answer,
    ):
        assert answer.status == status
        assert text in answer.read().decode()


def test_slow_requests_end_and_never_lock_others_out(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.view.server.TIMEOUT_S", 0.5)
    monkeypatch.setattr("nlos_cam.view.server.MAX_CONNECTIONS", 4)
    with closing(ViewServer(Served(ASSETS, streams), 0)) as server:
        place = urlsplit(server.address)
        slow = [socket.create_connection((place.hostname, place.port)) for _ in range(8)]
        for connection in slow:
            with suppress(OSError):
                connection.sendall(b"G")
        assert status_of(server.address, "/") == 200
        # each ends although it sends a byte now and then; the test's own limit ends a wait in vain
        while slow:
            slow = [connection for connection in slow if drips(connection)]


def drips(connection: socket.socket) -> bool:
    """Send a byte and return True while the server keeps the connection."""
    connection.settimeout(0.05)
    try:
        connection.sendall(b"E")
        kept = connection.recv(1) != b""
    except OSError as error:
        kept = isinstance(error, TimeoutError)
    if not kept:
        connection.close()
    return kept
