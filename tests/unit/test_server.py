import socket
from contextlib import closing
from http.client import HTTPConnection, HTTPException
from urllib.parse import urlsplit

import pytest
from view_streams import ASSETS, EVERYWHERE, Streams, ask

from nlos_cam.errors import NlosCamError
from nlos_cam.view import server as server_module
from nlos_cam.view.assets import LOOPBACK
from nlos_cam.view.server import ViewServer


def test_files_come_whole_with_their_type_and_nothing_may_come_from_elsewhere(server: ViewServer) -> None:
    for path, (kind, content) in ASSETS.items():
        with closing(ask(server.address, path + "?renderer=webgl")) as answer:
            assert answer.status == 200
            assert answer.headers["Content-Type"] == kind
            assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
            assert answer.read() == content


def test_connections_beyond_the_room_are_closed_and_those_before_live_on(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 1)
    server = ViewServer(ASSETS, streams, 0)
    with closing(ask(server.address, "/live.rrd")) as first:
        with pytest.raises((HTTPException, OSError)):
            ask(server.address, "/")
        assert first.read(2000) == b"x" * 2000
        streams.end.set()
    server.close()


def test_closing_cuts_browsers_that_neither_read_nor_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "CLOSE_AFTER_S", 0.01)
    server = ViewServer(ASSETS, lambda send: [send(bytes(1 << 20)) for _ in range(1000)] and None, 0)
    place = urlsplit(server.address)
    with socket.create_connection((place.hostname, place.port)) as silent, socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect((place.hostname, place.port))
        deaf.sendall(b"GET /live.rrd HTTP/1.0\r\nHost: localhost\r\n\r\n")
        assert deaf.recv(12) == b"HTTP/1.0 200"
        server.close()
        assert silent.recv(1) == b""


def test_a_port_that_is_asked_for_exactly_is_not_replaced(server: ViewServer, streams: Streams) -> None:
    busy = urlsplit(server.address).port or 0
    with pytest.raises(NlosCamError, match=rf"cannot be served at http://127.0.0.1:{busy}/ .* another --view-port"):
        ViewServer(ASSETS, streams, busy, exact=True)


def test_everywhere_it_is_found_on_this_machine_by_any_address_and_by_no_other_name(streams: Streams) -> None:
    everywhere = ViewServer(ASSETS, streams, 0, host=EVERYWHERE)
    try:
        assert urlsplit(everywhere.address).hostname == LOOPBACK
        for host, status in (("192.168.3.4:9090", 200), ("evil.example", 403)):
            with closing(ask(everywhere.address, "/", host=host)) as answer:
                assert answer.status == status
    finally:
        everywhere.close()


def test_an_address_that_is_not_this_machines_is_told(streams: Streams) -> None:
    with pytest.raises(NlosCamError, match=r"cannot be served at http://192.0.2.1:0/"):
        ViewServer(ASSETS, streams, 0, host="192.0.2.1")


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
