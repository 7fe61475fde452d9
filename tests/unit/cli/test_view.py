import os
import re
import signal
import socket
import webbrowser
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from made_up_moments import RIG, Recorded, full_moment
from small_frames import SheetNetwork
from view_streams import EVERYWHERE, ask

from nlos_cam.cli.main import main
from nlos_cam.cli.view import announce_view, opened_in_browser, saving, viewer_of
from nlos_cam.errors import NlosCamError
from nlos_cam.live import RunControl
from nlos_cam.reconstruct import CalibratedRig
from nlos_cam.view import NullViewer, SessionFile

BENCH = CalibratedRig(RIG)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    with SessionFile(tmp_path / "view.html", RIG) as view:
        view.show(full_moment(0))
    return tmp_path / "view.html"


def test_view_serves_a_saved_view_until_interrupted(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[bytes] = []

    def fetch_and_interrupt(text: str) -> None:
        with closing(ask(re.search(r"http://\S+", text)[0], "/")) as answer:  # type: ignore[index]
            fetched.append(answer.read())
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("nlos_cam.cli.view.say", fetch_and_interrupt)
    assert main(["view", str(saved)]) == 130
    assert fetched == [saved.read_bytes()]


def test_view_ends_after_its_seconds(saved: Path) -> None:
    assert main(["view", str(saved), "--seconds", "0.1"]) == 0


def test_saving_adds_a_file_to_another_viewer(tmp_path: Path) -> None:
    nobody = NullViewer()
    with saving(nobody, BENCH, None) as viewer:
        assert viewer is nobody
    with saving(nobody, BENCH, tmp_path / "view.html") as viewers:
        viewers.show(full_moment(0))
    assert (tmp_path / "view.html").stat().st_size > 10_000


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("nlos_cam.camera.open_camera", lambda *_, **__: Recorded(12))
    monkeypatch.setattr("nlos_cam.reconstruct.load_networks", lambda *_: SheetNetwork())
    monkeypatch.setattr("nlos_cam.reconstruct.load_uncertainty", lambda *_: None)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("opened")
def test_live_saves_its_view_and_overwrites_only_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["live", "--camera", "bag:fake", "--no-view", "--save-view", "view.html"]
    assert main(arguments) == 0
    assert "open view.html" in capsys.readouterr().err
    assert (tmp_path / "view.html").stat().st_size > 10_000
    assert main(arguments) == 1
    assert main([*arguments, "--overwrite"]) == 0


@pytest.mark.usefixtures("opened")
@pytest.mark.slow
def test_replay_saves_view_stills_and_video(tmp_path: Path) -> None:
    assert main(["replay", "run.bag", "--out", "out", "--save-view", "--stills", "2", "--video"]) == 0
    made = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"view.html", "replay.webm", "still-000000.png"} < made


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr("nlos_cam.cli.view.say", lambda text, **_: lines.append(text))
    return lines


def serve(*, no_view: bool = False, host: str | None = None, port: int | None = None, open_it: bool = False) -> None:
    """Serve a view with these options, print where, and end it."""
    with viewer_of(RunControl(), no_view=no_view, host=host, port=port) as viewer:
        announce_view(viewer, host=host, port=port, open_it=open_it)


def test_no_view_serves_nothing_and_refuses_an_address(printed: list[str]) -> None:
    serve(no_view=True, open_it=True)
    [line] = printed
    assert "http" not in line
    assert isinstance(viewer_of(RunControl(), no_view=True), NullViewer)
    for place in ({"host": "127.0.0.1"}, {"port": 9090}):
        with pytest.raises(typer.BadParameter, match="--no-view"):
            viewer_of(RunControl(), no_view=True, **place)


def test_view_is_on_the_loopback_by_default(printed: list[str]) -> None:
    serve()
    [line] = printed
    assert "http://127.0.0.1:" in line


def test_view_moves_from_a_taken_port_unless_asked_for(printed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for module in ("nlos_cam.view", "nlos_cam.view.web"):
            monkeypatch.setattr(f"{module}.PREFERRED_PORT", port)
        serve()
        [line] = printed
        assert f"{port} is taken" in line
        assert f"127.0.0.1:{port}/" not in line
        with pytest.raises(NlosCamError, match="--view-port"):
            serve(port=port)


def test_view_on_all_addresses_notes_who_can_see_it(printed: list[str]) -> None:
    serve(host=EVERYWHERE)
    line, note = printed
    assert "http://127.0.0.1:" in line
    assert "anyone" in note


@pytest.mark.parametrize("opens", [True, False])
def test_view_opens_a_browser_or_notes_that_it_cannot(
    printed: list[str], monkeypatch: pytest.MonkeyPatch, opens: bool
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("nlos_cam.cli.view.opened_in_browser", lambda address: asked.append(address) or opens)
    serve(open_it=True)
    assert asked[0].startswith("http://127.0.0.1:")
    assert ["browser" in line for line in printed[1:]] == [True] * (not opens)


def failing(_: str) -> bool:
    raise webbrowser.Error("no runnable browser")


@pytest.mark.parametrize(("desktop", "opens", "opened"), [
    ({}, lambda _: True, False),
    ({"DISPLAY": ":0"}, lambda _: True, True),
    ({"DISPLAY": ":0"}, lambda _: False, False),
    ({"BROWSER": "lynx"}, failing, False),
])  # fmt: skip
def test_opened_in_browser_only_with_a_desktop(
    monkeypatch: pytest.MonkeyPatch, desktop: dict[str, str], opens: Callable[[str], bool], opened: bool
) -> None:
    monkeypatch.setattr("nlos_cam.cli.view.sys", SimpleNamespace(platform="linux"))
    monkeypatch.setattr("nlos_cam.cli.view.os.environ", desktop)
    monkeypatch.setattr("nlos_cam.cli.view.webbrowser.open", opens)
    assert opened_in_browser("http://127.0.0.1:9090/") == opened
