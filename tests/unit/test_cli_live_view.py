import socket
import webbrowser
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from nlos_calibration.rig import load_rig

from nlos_cam.cli import view
from nlos_cam.cli.view import opened_in_browser, tell_of_view, viewer_of
from nlos_cam.errors import NlosCamError
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.view import web
from nlos_cam.view.viewer import NullViewer

BENCH = CalibratedRig(load_rig("paper-rig"))
EVERYWHERE = "0.0.0.0"  # noqa: S104  on purpose: what it exposes is told


@pytest.fixture(autouse=True)
def no_assets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "page_assets", dict)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr(view, "say", lambda text, **_: lines.append(text))
    return lines


def shown(told: list[str], **options: Any) -> list[str]:
    """What is told of a view that is served with these options."""
    host, port = options.get("host"), options.get("port")
    with viewer_of(BENCH, no_view=options.get("no_view", False), host=host, port=port) as viewer:
        tell_of_view(viewer, host=host, port=port, open_it=options.get("open_it", False))
    return told


def test_without_a_view_that_is_told_and_no_place_for_one_may_be_named(told: list[str]) -> None:
    assert shown(told, no_view=True, open_it=True) == ["running without a view (Ctrl-C ends it)"]
    assert isinstance(viewer_of(BENCH, no_view=True), NullViewer)
    for place in ({"host": "127.0.0.1"}, {"port": 9090}):
        with pytest.raises(typer.BadParameter, match="leave --no-view away"):
            viewer_of(BENCH, no_view=True, **place)


def test_unless_asked_nobody_else_can_see_it(told: list[str]) -> None:
    [line] = shown(told)
    assert line.startswith("live view: http://127.0.0.1:")


def test_a_taken_port_is_told_and_the_view_is_elsewhere(told: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setattr(web, "PREFERRED_PORT", port)
        [line] = shown(told)
        assert f"port {port} is taken" in line
        assert f"127.0.0.1:{port}/" not in line
        with pytest.raises(NlosCamError, match="another --view-port"):
            shown(told, port=port)


def test_what_others_see_is_told_in_one_line(told: list[str]) -> None:
    line, note = shown(told, host=EVERYWHERE)
    assert line.startswith("live view: http://127.0.0.1:")
    assert "anyone who can reach any address of this machine" in note


@pytest.mark.parametrize("opens", [True, False])
def test_a_browser_is_opened_or_its_lack_is_a_note(
    told: list[str], monkeypatch: pytest.MonkeyPatch, opens: bool
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(view, "opened_in_browser", lambda address: asked.append(address) or opens)
    lines = shown(told, open_it=True)
    assert asked[0].startswith("http://127.0.0.1:")
    assert [line for line in lines[1:] if "no browser could be opened" in line] == lines[1:]
    assert len(lines) == 1 + (not opens)


def failing(_: str) -> bool:
    raise webbrowser.Error("no runnable browser")


@pytest.mark.parametrize(("desktop", "opens", "opened"), [
    ({}, lambda _: True, False),
    ({"DISPLAY": ":0"}, lambda _: True, True),
    ({"DISPLAY": ":0"}, lambda _: False, False),
    ({"BROWSER": "lynx"}, failing, False),
])  # fmt: skip
def test_only_a_browser_with_a_window_is_opened(
    monkeypatch: pytest.MonkeyPatch, desktop: dict[str, str], opens: Callable[[str], bool], opened: bool
) -> None:
    monkeypatch.setattr(view, "sys", SimpleNamespace(platform="linux"))
    monkeypatch.setattr(view.os, "environ", desktop)
    monkeypatch.setattr(view.webbrowser, "open", opens)
    assert opened_in_browser("http://127.0.0.1:9090/") == opened
