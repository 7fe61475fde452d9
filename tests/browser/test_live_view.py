"""`nlos-cam live --camera sim` in a headless Chromium, drawn in software: slow, but the real thing."""

import io
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
DRAW_TIMEOUT_S = 180.0
SIZE = {"width": 1280, "height": 800}
RECONSTRUCTION = slice(35, 475), slice(5, 450)
PLOT = slice(510, 795), slice(835, 1275)
"""Rows and columns of the page."""
PAGE_RGB, LATENCY_RGB = (13, 16, 17), (80, 200, 120)

Pixels = np.ndarray


class LiveView:
    """The program, running and serving its view."""

    def __init__(self) -> None:
        program = [sys.executable, "-c", "from nlos_cam.cli.main import run; run()"]
        self.process = subprocess.Popen(
            [*program, "live", "--camera", "sim"], stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        self.address = self._address()

    def _address(self) -> str:
        """From what the program tells on stderr; a first run renders its scene before."""
        told = []
        for line in self.process.stderr or ():
            told.append(line)
            if found := re.search(r"http://127\.0\.0\.1:\d+/\S*", line):
                return found[0]
        pytest.fail(f"no address in what the program told: {''.join(told)}")

    def interrupt(self) -> int:
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=60)
        return self.process.returncode

    def kill(self) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGTERM)
            self.process.communicate(timeout=60)


@pytest.fixture
def view() -> Iterator[LiveView]:
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if not Path(CHROMIUM).exists():
        pytest.skip("needs Chromium: install it as /usr/bin/chromium or on PATH")
    view = LiveView()
    yield view
    view.kill()


def pixels(png: bytes) -> Pixels:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def look(page: Any, deadline_s: float) -> Pixels:
    """The page as it is now; a browser too busy drawing to hand out a picture is asked again."""
    from playwright.sync_api import Error

    while True:
        try:
            return pixels(page.screenshot(timeout=60_000))
        except Error:
            if time.monotonic() > deadline_s:
                raise
            page.wait_for_timeout(1000)


def share_unlike(image: Pixels, rgb: tuple[int, int, int]) -> float:
    return float((np.abs(image - rgb).max(axis=-1) > 60).mean())


def share_like(image: Pixels, rgb: tuple[int, int, int]) -> float:
    return float((np.abs(image - rgb).max(axis=-1) < 40).mean())


def is_drawn(image: Pixels) -> bool:
    """Whether there is a surface in the reconstruction's panel, and a line in the plot."""
    return share_unlike(image[RECONSTRUCTION], PAGE_RGB) > 0.02 and share_like(image[PLOT], LATENCY_RGB) > 0.0005


def test_the_page_draws_a_reconstruction_that_moves_and_a_plot_and_fetches_nothing_elsewhere(view: LiveView) -> None:
    from playwright.sync_api import sync_playwright

    hosts: set[str | None] = set()
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL) as browser,
    ):
        page = browser.new_page(viewport=SIZE)
        page.on("request", lambda request: hosts.add(urlsplit(request.url).hostname))
        page.goto(view.address, wait_until="commit")
        deadline_s = time.monotonic() + DRAW_TIMEOUT_S
        first = look(page, deadline_s)
        while not is_drawn(first):
            assert time.monotonic() < deadline_s, f"not drawn within {DRAW_TIMEOUT_S:.0f} s"
            page.wait_for_timeout(1000)
            first = look(page, deadline_s)
        changed = 0.0
        while changed < 0.005:
            assert time.monotonic() < deadline_s, "the reconstruction does not change"
            page.wait_for_timeout(500)
            later = look(page, deadline_s)
            changed = float((np.abs(later - first)[RECONSTRUCTION].max(axis=-1) > 40).mean())
    assert hosts <= {"127.0.0.1", None}, "the page fetched from elsewhere"
    assert view.interrupt() == 130
    assert_gone(view)


def assert_gone(view: LiveView) -> None:
    """Nothing listens at the address any more, and no process of the program's session is left."""
    parts = urlsplit(view.address)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((parts.hostname, parts.port), timeout=5.0)
    with pytest.raises(ProcessLookupError):
        os.killpg(view.process.pid, 0)
