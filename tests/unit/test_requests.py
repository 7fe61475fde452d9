from contextlib import closing

import pytest
from view_streams import ASSETS, Streams, ask

from nlos_cam.view.server import ViewServer


def test_a_head_tells_what_a_get_would_without_its_content(server: ViewServer) -> None:
    for path, (_, content) in ASSETS.items():
        with closing(ask(server.address, path, method="HEAD")) as answer:
            assert answer.status == 200
            assert int(answer.headers["Content-Length"]) == len(content)
            assert answer.read() == b""


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_nothing_can_be_sent(server: ViewServer, method: str) -> None:
    with closing(ask(server.address, "/", method=method)) as answer:
        assert answer.status == 501


@pytest.mark.parametrize("host", ["evil.example", "evil.example:9090", "127.0.0.1.evil.example", "10.1.2.3", ""])
@pytest.mark.parametrize("path", ["/", "/live.rrd"])
def test_a_name_that_is_not_this_machines_is_refused(server: ViewServer, host: str, path: str) -> None:
    with closing(ask(server.address, path, host=host)) as answer:
        assert answer.status == 403
        assert b"page" not in answer.read()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost:80", "LOCALHOST:8000", "[::1]:9090"])
def test_the_loopbacks_names_are_answered_at_any_port_since_ports_are_forwarded(server: ViewServer, host: str) -> None:
    with closing(ask(server.address, "/", host=host)) as answer:
        assert answer.status == 200


def test_only_so_many_watch_and_one_that_leaves_makes_room(streams: Streams) -> None:
    server = ViewServer(ASSETS, streams, 0, most_streams=2)
    watching = [ask(server.address, "/live.rrd") for _ in range(2)]
    with closing(ask(server.address, "/live.rrd")) as refused:
        assert refused.status == 503
        assert b"2 browsers watch already" in refused.read()
    with closing(ask(server.address, "/")) as page:
        assert page.status == 200
    streams.end.set()
    for answer in watching:
        answer.read()
        answer.close()
    streams.end.clear()
    for _ in range(1000):  # its thread ends after the browser has seen it end
        with closing(ask(server.address, "/live.rrd")) as again:
            if again.status == 200:
                break
    assert again.status == 200
    streams.end.set()
    server.close()
