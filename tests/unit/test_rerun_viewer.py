import threading
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from threading import Event
from urllib.parse import urlsplit

import pytest
from made_up_moments import RIG, full_moment, moment
from measured_walls import exact_wall

from nlos_cam.view import web
from nlos_cam.view.drawing import Drawing
from nlos_cam.view.viewer import Moment
from nlos_cam.view.web import WebViewer


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Iterator[WebViewer]:
    monkeypatch.setattr(web, "page_assets", lambda: {"/": ("text/html", b"page")})
    with WebViewer(RIG) as viewer:
        yield viewer
    with pytest.raises(ConnectionRefusedError):
        connected(viewer).connect()


def connected(viewer: WebViewer) -> HTTPConnection:
    return HTTPConnection(urlsplit(viewer.address or "").netloc, timeout=10.0)


def test_a_browser_gets_the_moments_shown_while_it_watches(viewer: WebViewer) -> None:
    viewer.show(moment(0))
    with closing(connected(viewer)) as browser:
        browser.request("GET", "/live.rrd")
        with closing(browser.getresponse()) as answer:
            assert answer.read(4) == b"RRF2"
            for number in range(1, 4):
                viewer.show(moment(number))
                assert answer.read(2000)


def test_two_browsers_watch_independently(viewer: WebViewer) -> None:
    viewer.show(moment(0))
    for _ in range(2):
        with closing(connected(viewer)) as browser:
            browser.request("GET", "/live.rrd")
            with closing(browser.getresponse()) as answer:
                assert answer.read(4) == b"RRF2"


def test_leaving_ends_the_streams_of_browsers_that_still_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "page_assets", dict)
    with WebViewer(RIG) as viewer:
        browser = connected(viewer)
        browser.request("GET", "/live.rrd")
        answer = browser.getresponse()
        viewer.show(moment(0))
        assert answer.read(4) == b"RRF2"
    answer.read()
    answer.close()
    browser.close()


def test_showing_costs_nothing_when_nobody_watches(viewer: WebViewer) -> None:
    for number in range(1000):
        viewer.show(moment(number))
    assert threading.active_count() <= 3


def test_a_measured_wall_reaches_each_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "page_assets", dict)
    with WebViewer(RIG, exact_wall()) as viewer:
        viewer.show(moment(0))
        for _ in range(2):
            with closing(connected(viewer)) as browser:
                browser.request("GET", "/live.rrd")
                with closing(browser.getresponse()) as answer:
                    received = b""
                    while b"bench/measured/footprint" not in received:
                        chunk = answer.read1()
                        assert chunk, "the stream ended without the footprint"
                        received += chunk


class Starved:
    """A browser that takes what it is sent only when let."""

    def __init__(self) -> None:
        self.asked, self.let, self.taken = Event(), Event(), []

    def __call__(self, content: bytes) -> None:
        self.asked.set()
        if not self.let.wait(10.0):
            raise TimeoutError
        self.taken.append(content)


def test_nothing_is_drawn_or_kept_for_a_browser_that_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "page_assets", dict)
    drawn = []
    draw = Drawing.draw

    def noted(self: Drawing, each: Moment, **options: bool) -> None:
        drawn.append(each.frame.frame_number)
        draw(self, each, **options)

    monkeypatch.setattr(Drawing, "draw", noted)
    browser = Starved()
    with WebViewer(RIG) as viewer:
        thread = threading.Thread(target=viewer._stream, args=(browser,))
        thread.start()
        viewer.show(full_moment(0))
        assert browser.asked.wait(10.0)
        for number in range(1, 500):
            viewer.show(moment(number))
        assert drawn == [0]
        browser.let.set()
        viewer.show(moment(500))
        while len(drawn) < 2:
            Event().wait(0.01)
    thread.join(10.0)
    assert drawn[1] >= 499, "it sees the newest, and not those that it missed"
    assert len(browser.taken) == len(drawn)


def test_a_page_that_is_opened_again_begins_anew(viewer: WebViewer) -> None:
    viewer.show(full_moment(0))
    for _ in range(3):
        with closing(connected(viewer)) as browser:
            browser.request("GET", "/live.rrd")
            with closing(browser.getresponse()) as answer:
                received = b""
                while b"bench/wall" not in received or b"uncertainty" not in received:
                    received += answer.read1()
