"""`nlos-cam live --camera sim` in a headless Chromium, drawn in software: slow, but the real thing."""

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest
from browser_page import Page, Pixels, needs_browser, share_changed, share_unlike

pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]

RECONSTRUCTION = slice(125, 475), slice(5, 370)
PLOTS = slice(512, 795), slice(920, 1275)
"""Rows and columns of the page."""
PAGE_RGB = (13, 16, 17)


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
    needs_browser()
    view = LiveView()
    yield view
    view.kill()


def is_drawn(image: Pixels) -> bool:
    """Whether there is a surface in the reconstruction's panel, and a line in the plot."""
    return share_unlike(image[RECONSTRUCTION], PAGE_RGB) > 0.02 and share_unlike(image[PLOTS], PAGE_RGB) > 0.0005


def test_the_page_draws_a_reconstruction_that_moves_and_a_plot_and_fetches_nothing_elsewhere(
    view: LiveView, browser: Any
) -> None:
    page = Page(browser, view.address)
    first = page.until(is_drawn, "a reconstruction and a plot")
    page.until(lambda now: share_changed(first, now, RECONSTRUCTION) > 0.005, "the reconstruction changes")
    page.close()
    assert page.hosts <= {"127.0.0.1", None}, "the page fetched from elsewhere"
    assert view.interrupt() == 130
    assert_gone(view)


def assert_gone(view: LiveView) -> None:
    """Nothing listens at the address any more, and no process of the program's session is left."""
    parts = urlsplit(view.address)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((parts.hostname, parts.port), timeout=5.0)
    with pytest.raises(ProcessLookupError):
        os.killpg(view.process.pid, 0)
