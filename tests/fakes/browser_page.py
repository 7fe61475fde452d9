"""A page of the view in a headless Chromium that draws in software, looked at by its pixels."""

import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np
import pytest
from headless_chromium import CHROMIUM
from PIL import Image

from nlos_cam.view.viewer import Moment, Viewer

SIZE = {"width": 1280, "height": 800}
DRAW_TIMEOUT_S = 180.0
BUTTONS_PX, TAB_GAP_PX, MIN_TAB_PX, HEADER_PX = 105, 10, 24, 14
"""Of a panel's header: what its buttons take on the right, what parts its tabs, and what is no tab; its middle."""
NOWHERE = 620, 107
"""Where the mouse hovers over nothing: what it hovers over looks otherwise."""
FEED_S = 0.25

Pixels = np.ndarray
Region = tuple[slice, slice]
"""Rows and columns of the page."""


def needs_browser() -> None:
    """Skip what cannot be looked at."""
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if not Path(CHROMIUM).exists():
        pytest.skip("needs Chromium: install it as /usr/bin/chromium or on PATH")


class Page:
    """A page that is open at an address."""

    def __init__(self, browser: Any, address: str) -> None:
        self.hosts: set[str | None] = set()
        """Where it fetched from."""
        self.page = browser.new_page(viewport=SIZE)
        self.page.on("request", lambda request: self.hosts.add(urlsplit(request.url).hostname))
        self.page.goto(address, wait_until="commit", timeout=1e3 * DRAW_TIMEOUT_S)

    def look(self) -> Pixels:
        """The page as it is now; a browser too busy drawing to hand out a picture is asked again."""
        from playwright.sync_api import Error

        deadline_s = time.monotonic() + DRAW_TIMEOUT_S
        while True:
            try:
                png = self.page.screenshot(timeout=60_000)
            except Error:
                if time.monotonic() > deadline_s:
                    raise
                self.page.wait_for_timeout(1000)
            else:
                return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)

    def until(self, holds: Callable[[Pixels], bool], what: str) -> Pixels:
        """Look until it holds; fails where it does not in time."""
        deadline_s = time.monotonic() + DRAW_TIMEOUT_S
        while not holds(seen := self.look()):
            if time.monotonic() > deadline_s:
                picture = Path(tempfile.gettempdir()) / "page.png"
                Image.fromarray(seen.astype(np.uint8)).save(picture)
                pytest.fail(f"not within {DRAW_TIMEOUT_S:.0f} s: {what}; the page is in {picture}")
            self.page.wait_for_timeout(300)
        return seen

    def click(self, x: float, y: float) -> None:
        self.page.mouse.click(x, y)
        self.page.mouse.move(*NOWHERE)

    def open_tab(self, number: int, region: Region, before: Pixels) -> None:
        """Open a tab of the panel that is below its header, by where it was before any was clicked, and looked so."""
        top, left = region[0].start - HEADER_PX, region[1].start
        middles = tab_middles(before[top - 8 : top + 8, left : region[1].stop - BUTTONS_PX])
        assert len(middles) > number, f"only {len(middles)} tabs"
        self.click(left + middles[number], top)

    def close(self) -> None:
        self.page.close()


def tab_middles(header: Pixels) -> list[float]:
    """Where the tabs of a header are, from its left: runs of columns that are not plain."""
    written = (np.ptp(header, axis=0).max(axis=-1) > 40).nonzero()[0]
    if len(written) == 0:
        return []
    runs = np.split(written, np.flatnonzero(np.diff(written) > TAB_GAP_PX) + 1)
    return [float(run.mean()) for run in runs if np.ptp(run) >= MIN_TAB_PX]


def share_like(image: Pixels, rgb: tuple[int, int, int]) -> float:
    return float((np.abs(image - rgb).max(axis=-1) < 40).mean())


def share_unlike(image: Pixels, rgb: tuple[int, int, int]) -> float:
    return float((np.abs(image - rgb).max(axis=-1) > 60).mean())


def share_changed(before: Pixels, after: Pixels, region: Region) -> float:
    return float((np.abs(after - before)[region].max(axis=-1) > 40).mean())


class Feed:
    """Shows a viewer the moment that `make` gives, four times a second, while entered."""

    def __init__(self, viewer: Viewer, make: Callable[[int], Moment]) -> None:
        self.make = make
        self._viewer, self._stop = viewer, Event()
        self._thread = Thread(target=self._run, name="feed")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(FEED_S):
            self._viewer.show(self.make(number))
            number += 1
