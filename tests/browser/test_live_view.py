"""`nlos-cam live --camera sim` in a headless Chromium, drawn in software."""

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
from browser_page import DEADLINE_S, Page, needs_browser

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(4 * DEADLINE_S)]


class LiveView:
    """The program, running and serving its view."""

    def __init__(self) -> None:
        program = [sys.executable, "-c", "from nlos_cam.cli.main import run; run()"]
        self.process = subprocess.Popen(
            [*program, "live", "--camera", "sim"], stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        self.address = self._address()

    def _address(self) -> str:
        """Read the address from stderr; a first run renders its scene before."""
        lines = []
        for line in self.process.stderr or ():
            lines.append(line)
            if found := re.search(r"http://127\.0\.0\.1:\d+/\S*", line):
                return found[0]
        pytest.fail(f"the program printed no address: {''.join(lines)}")

    def interrupt(self) -> int:
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode

    def kill(self) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGTERM)
            self.process.communicate(timeout=DEADLINE_S)


@pytest.fixture
def view() -> Iterator[LiveView]:
    needs_browser()
    view = LiveView()
    yield view
    view.kill()


def test_page_receives_frames_and_fetches_from_nowhere_else(view: LiveView, browser: Any) -> None:
    page = Page(browser, view.address)
    page.wait_until(lambda: {"/reconstruction", "/latency"} <= set(page.frames()), "a reconstruction and a plot")
    first = page.frames()["/latency"]
    page.wait_until(lambda: page.frames()["/latency"] > first, "later frames")
    assert not page.has_panicked()
    page.close()
    assert page.hosts <= {"127.0.0.1", None}, "the page fetched from elsewhere"
    assert view.interrupt() == 130
    parts = urlsplit(view.address)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((parts.hostname, parts.port), timeout=60.0)
    with pytest.raises(ProcessLookupError):
        os.killpg(view.process.pid, 0)
