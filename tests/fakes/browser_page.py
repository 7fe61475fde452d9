"""Page of the view in a headless Chromium, asked for its own state: no test depends on how fast it draws."""

import base64
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from rerun.chunk import RrdReader
from screenshots import CHROMIUM

SIZE = {"width": 1280, "height": 800}
DEADLINE_S = 900.0
"""No machine on which the page works takes this long for one step."""
EXPOSE_VIEWER = """
;wasm_bindgen.WebHandle = class extends wasm_bindgen.WebHandle {
  constructor(...options) { super(...options); window.viewer = this; }
};"""
"""Appended to Rerun's script, so that the page's viewer can be asked."""


def needs_browser() -> None:
    """Skip a test where there is no browser."""
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if not Path(CHROMIUM).exists():
        pytest.skip("needs Chromium: install it as /usr/bin/chromium or on PATH")


class Page:
    """Page at an address, with its viewer started."""

    def __init__(self, browser: Any, address: str) -> None:
        self.hosts: set[str | None] = set()
        """Hosts from which it fetched."""
        self.page = browser.new_page(viewport=SIZE)
        self.page.on("request", lambda request: self.hosts.add(urlsplit(request.url).hostname))
        self.page.route("**/re_viewer.js", self._expose_viewer)
        self.page.goto(address, wait_until="commit", timeout=1e3 * DEADLINE_S)
        self.page.locator("#note").wait_for(state="detached", timeout=1e3 * DEADLINE_S)

    @staticmethod
    def _expose_viewer(route: Any) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, body=answer.text() + EXPOSE_VIEWER)

    def ask(self, method: str) -> bytes:
        """Return the bytes that a method of the page's viewer gives; none while there is no recording."""
        text = f"btoa(Array.from(viewer.{method}(), (byte) => String.fromCharCode(byte)).join(''))"
        return base64.b64decode(self.page.evaluate(f"(() => {{ try {{ return {text} }} catch {{ return '' }} }})()"))

    def has_panicked(self) -> bool:
        return bool(self.page.evaluate("viewer.has_panicked()"))

    def views(self) -> dict[str, str]:
        """Return the views of the page: their names and the paths that they show."""
        state = protobuf_fields(self.ask("viewer_state"))
        named = [protobuf_fields(view) for view in state.get(5, ())]
        return {view[3][0].decode(): view[4][0].decode() for view in named if 3 in view}

    def cursor_s(self) -> float:
        """Return the time at which the page shows its recording, in seconds."""
        playing = protobuf_fields(protobuf_fields(self.ask("viewer_state"))[3][0])
        cursor = protobuf_fields(protobuf_fields(playing[3][0])[3][0])
        return cursor.get(1, [0])[0] / 1e9

    def frames(self) -> dict[str, int]:
        """Return the newest frame of each path in the page's recording; -1 for what has no time."""
        if not (content := self.ask("save_recording")):
            return {}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "page.rrd"
            path.write_bytes(content)
            reader = RrdReader(path)
            chunks = reader.stream().to_chunks() if reader.recordings() else []
        newest: dict[str, int] = {}
        for chunk in chunks:
            numbers = [-1] if chunk.is_static else chunk.to_record_batch().column("frame").to_pylist()
            newest[chunk.entity_path] = max(newest.get(chunk.entity_path, -1), *numbers)
        return newest

    def wait_until(self, holds: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + DEADLINE_S
        while not holds():
            if time.monotonic() > deadline_s:
                pytest.fail(f"not within {DEADLINE_S:.0f} s: {what}")
            self.page.wait_for_timeout(300)

    def close(self) -> None:
        self.page.close()


def protobuf_fields(message: bytes) -> dict[int, list[Any]]:
    """Return the fields of an encoded message by number: whole numbers, and bytes of texts and messages."""
    found: dict[int, list[Any]] = {}
    at = 0

    def number() -> int:
        nonlocal at
        value, shift = 0, 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(message):
        key = number()
        if key & 7 == 0:
            found.setdefault(key >> 3, []).append(number())
            continue
        size = {1: 8, 5: 4}.get(key & 7) or number()
        found.setdefault(key >> 3, []).append(message[at : at + size])
        at += size
    return found
