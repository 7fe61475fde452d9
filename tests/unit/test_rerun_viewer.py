import threading
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from urllib.parse import urlsplit

import numpy as np
import pytest
from measured_walls import exact_wall
from nlos_calibration.rig import load_rig

from nlos_cam.frames import Frame
from nlos_cam.objects.depth_image import object_box
from nlos_cam.reconstruct import Reconstruction, pose_of
from nlos_cam.view import rerun_viewer
from nlos_cam.view.rerun_viewer import RerunViewer
from nlos_cam.view.viewer import Moment

RIG = load_rig("paper-rig")


def moment(number: int) -> Moment:
    depth_m, ir = np.full((64, 80), 0.3, np.float32), np.full((64, 80), 40, np.uint8)
    frame = Frame(depth_m, ir, ir, number / 30, number, RIG.pinhole.scaled(80, 64))
    hidden_m = np.full((64, 64), 0.2, np.float32)
    return Moment(frame, Reconstruction(hidden_m, pose_of(object_box(RIG)), None, {}), number / 30, 0.02)


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Iterator[RerunViewer]:
    monkeypatch.setattr(rerun_viewer, "page_assets", lambda: {"/": ("text/html", b"page")})
    with RerunViewer(RIG) as viewer:
        yield viewer
    with pytest.raises(ConnectionRefusedError):
        connected(viewer).connect()


def connected(viewer: RerunViewer) -> HTTPConnection:
    return HTTPConnection(urlsplit(viewer.address or "").netloc, timeout=10.0)


def test_a_browser_gets_the_moments_shown_while_it_watches(viewer: RerunViewer) -> None:
    viewer.show(moment(0))
    with closing(connected(viewer)) as browser:
        browser.request("GET", "/live.rrd")
        with closing(browser.getresponse()) as answer:
            assert answer.read(4) == b"RRF2"
            for number in range(1, 4):
                viewer.show(moment(number))
                assert answer.read(2000)


def test_two_browsers_watch_independently(viewer: RerunViewer) -> None:
    viewer.show(moment(0))
    for _ in range(2):
        with closing(connected(viewer)) as browser:
            browser.request("GET", "/live.rrd")
            with closing(browser.getresponse()) as answer:
                assert answer.read(4) == b"RRF2"


def test_leaving_ends_the_streams_of_browsers_that_still_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_viewer, "page_assets", dict)
    with RerunViewer(RIG) as viewer:
        browser = connected(viewer)
        browser.request("GET", "/live.rrd")
        answer = browser.getresponse()
        viewer.show(moment(0))
        assert answer.read(4) == b"RRF2"
    answer.read()
    answer.close()
    browser.close()


def test_showing_costs_nothing_when_nobody_watches(viewer: RerunViewer) -> None:
    for number in range(1000):
        viewer.show(moment(number))
    assert threading.active_count() <= 3


def test_a_measured_wall_reaches_each_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_viewer, "page_assets", dict)
    with RerunViewer(RIG, exact_wall()) as viewer:
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
