import re
import subprocess
from importlib import resources
from typing import Any

import pytest

from nlos_cam.errors import NlosCamError
from nlos_cam.view.assets import page_assets


@pytest.mark.slow
def test_page_assets_are_whole_and_their_server_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr("nlos_cam.view.assets.subprocess.Popen", Noted)
    files = page_assets()
    assert set(files) == {"/", "/re_viewer.js", "/re_viewer_bg.wasm"}
    assert files["/re_viewer_bg.wasm"][1].startswith(b"\0asm")
    assert b"wasm_bindgen" in files["/re_viewer.js"][1]
    assert [server.returncode is None for server in started] == [False]


def test_page_shows_the_time_panel_of_a_recording_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.assets._fetch", lambda *_: b"")
    live, recorded = (page_assets(recorded=recorded)["/"][1] for recorded in (False, True))
    assert b'data-time="live"' in live
    assert live.replace(b'data-time="live"', b'data-time="recorded"') == recorded != live


def test_page_names_no_other_host() -> None:
    page = (resources.files("nlos_cam.view") / "page.html").read_text(encoding="utf-8")
    assert re.findall(r"https?:|//[a-z]", page) == []


def test_page_assets_of_a_failed_viewer_suggest_no_view(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.assets._rerun_program", lambda: "false")
    with pytest.raises(NlosCamError, match="--no-view"):
        page_assets()
