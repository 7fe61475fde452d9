"""The live loop with a browser that asks for the stream and then reads nothing of it."""

import socket
from collections.abc import Iterator
from threading import Event
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from nlos_calibration import load_rig
from small_frames import FrameCamera, sheet_network

from nlos_cam.frames import Frame
from nlos_cam.live import run_live
from nlos_cam.reconstruct import CalibratedRig, Pipeline
from nlos_cam.view import WebViewer
from nlos_cam.view.server import Send

RIG = load_rig("paper-rig")
MAX_WAITING_FRAMES = 100
"""Frames for which the browser leaves one piece of the stream unread."""
PATIENCE = 100_000


class Noted(WebViewer):
    """Viewer that counts the pieces of its streams that a browser was given, and those that it took."""

    given = taken = 0

    def _stream(self, send: Send) -> None:
        def noting(content: bytes) -> None:
            self.given += 1
            send(content)
            self.taken += 1

        super()._stream(noting)


class Camera(FrameCamera):
    """Camera of noise that ends once a browser has kept a piece of the stream waiting for MAX_WAITING_FRAMES frames."""

    intrinsics = RIG.pinhole

    def __init__(self, viewer: Noted) -> None:
        super().__init__(None)
        self._viewer, self.kept_waiting = viewer, 0

    def __iter__(self) -> Iterator[Frame]:
        generator, waited_for = np.random.default_rng(0), -1
        shape = RIG.pinhole.height, RIG.pinhole.width
        noise_m, ir = generator.random(shape, np.float32), generator.integers(0, 255, shape, np.uint8)
        for number in range(PATIENCE):
            waits = self._viewer.given > self._viewer.taken == waited_for
            self.kept_waiting = self.kept_waiting + 1 if waits else 0
            waited_for = self._viewer.taken
            if self.kept_waiting == MAX_WAITING_FRAMES:
                return
            yield Frame(noise_m, ir, ir, number / 1000, number, RIG.pinhole)


@pytest.mark.slow
def test_live_loop_never_waits_for_a_browser_that_reads_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.web.PERIOD_S", 0.0)
    with Noted(RIG) as viewer, socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        place = urlsplit(viewer.address or "")
        deaf.connect((place.hostname, place.port))
        deaf.sendall(b"GET /stream HTTP/1.0\r\nHost: localhost\r\n\r\n")
        camera: Any = Camera(viewer)
        report = run_live(camera, Pipeline(CalibratedRig(RIG), sheet_network), viewer, stop=Event(), recorded=True)
    assert camera.kept_waiting == MAX_WAITING_FRAMES
    assert report.frames > MAX_WAITING_FRAMES
    assert report.dropped == 0
