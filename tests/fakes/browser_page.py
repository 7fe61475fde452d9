"""Page of the view in a headless Chromium, asked for its own state: no test depends on how fast it
draws.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

import pytest
from screenshots import CHROMIUM

DEADLINE_S = 120.0
"""No machine on which the page works takes this long for one step."""


def needs_browser() -> None:
    """Skip a test where there is no browser."""
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if not Path(CHROMIUM).exists():
        pytest.skip("needs Chromium: install it as /usr/bin/chromium or on PATH")


class Page:
    """Page at an address, opened."""

    def __init__(self, browser: Any, address: str, size: tuple[int, int] = (1280, 800)) -> None:
        self.hosts: set[str | None] = set()
        """Hosts from which it fetched."""
        self.errors: list[str] = []
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.on("request", lambda request: self.hosts.add(urlsplit(request.url).hostname))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address, wait_until="commit", timeout=1e3 * DEADLINE_S)

    def state(self) -> dict[str, Any]:
        """Return what the page shows; empty while it loads."""
        return self.page.evaluate("window.nlos ? nlos.state() : {}")

    def drawn(self) -> Self:
        """Wait for a drawn moment, and return the page."""
        self.wait_until(lambda: self.state().get("shown", 0) > 0, "a drawn moment")
        return self

    def wait_until(self, holds: Callable[[], bool], purpose: str) -> None:
        deadline_s = time.monotonic() + DEADLINE_S
        while not holds():
            if time.monotonic() > deadline_s:
                pytest.fail(f"not within {DEADLINE_S:.0f} s: {purpose}; {self.state()}")
            self.page.wait_for_timeout(50)

    def answer(self, act: Callable[[], object]) -> str:
        """Do something that runs a command, and return its answer."""
        self.page.evaluate("document.querySelector('#answer').textContent = ''; undefined")
        act()
        finished = "(t => t && !t.endsWith('…'))(document.querySelector('#answer').textContent)"
        self.wait_until(lambda: self.page.evaluate(finished), "the command's answer")
        return self.state()["answer"]

    def click(self, selector: str) -> str:
        """Click a control, and return the command's answer."""
        return self.answer(
            lambda: self.page.evaluate(f"document.querySelector('{selector}').click()")
        )

    def close(self) -> None:
        self.page.close()
