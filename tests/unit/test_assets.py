import re
import subprocess
from importlib import resources
from typing import Any

import pytest

from nlos_cam.errors import NlosCamError
from nlos_cam.view import assets
from nlos_cam.view.assets import page_assets


def test_the_viewers_files_come_whole_and_their_server_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(assets.subprocess, "Popen", Noted)
    files = page_assets()
    assert set(files) == {"/", "/re_viewer.js", "/re_viewer_bg.wasm"}
    assert files["/re_viewer_bg.wasm"][1].startswith(b"\0asm")
    assert b"wasm_bindgen" in files["/re_viewer.js"][1]
    assert [server.returncode is None for server in started] == [False]


def test_the_page_of_what_is_recorded_shows_its_time_and_the_live_one_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "_fetch", lambda *_: b"")
    live, recorded = (page_assets(recorded=recorded)["/"][1] for recorded in (False, True))
    assert b'data-time="live"' in live
    assert live.replace(b'data-time="live"', b'data-time="recorded"') == recorded != live


def test_our_page_names_no_other_host() -> None:
    page = (resources.files("nlos_cam.view") / "page.html").read_text(encoding="utf-8")
    assert re.findall(r"https?:|//[a-z]", page) == []


def test_a_viewer_that_does_not_start_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "_rerun_program", lambda: "false")
    with pytest.raises(NlosCamError, match="--no-view"):
        page_assets()
