import os
import re
import signal
import threading
from collections.abc import Callable
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import typer
from made_up_moments import RIG, full_moment

from nlos_cam.bench import Bench
from nlos_cam.cli import view as commands
from nlos_cam.cli.main import main
from nlos_cam.cli.view import saved_as, saving
from nlos_cam.errors import OutputExistsError
from nlos_cam.view import recorded
from nlos_cam.view.saved_view import SavedView
from nlos_cam.view.viewer import NullViewer


@pytest.fixture
def saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(recorded, "page_assets", lambda **_: {"/": ("text/html", b"page")})
    with SavedView(tmp_path / "view.rrd", RIG) as view:
        view.show(full_moment(0))
    return tmp_path / "view.rrd"


def on_address(monkeypatch: pytest.MonkeyPatch, act: Callable[[str], None]) -> None:
    """Act once the address is told."""

    def say(text: str) -> None:
        act(re.search(r"http://\S+", text)[0])  # type: ignore[index]

    monkeypatch.setattr(commands, "say", say)


def test_a_saved_view_is_served_until_ctrl_c(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[bytes] = []

    def fetch(address: str) -> None:
        connection = HTTPConnection(urlsplit(address).netloc, timeout=10.0)
        connection.request("GET", "/live.rrd")
        fetched.append(connection.getresponse().read())
        connection.close()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()

    on_address(monkeypatch, fetch)
    assert main(["view", str(saved), "--port", "0"]) == 130
    assert fetched == [saved.read_bytes()]


def test_seconds_end_it(saved: Path) -> None:
    assert main(["view", str(saved), "--seconds", "0.1", "--port", "0"]) == 0


def test_no_such_file_is_an_unreadable_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "none.rrd")]) == 4
    assert "none.rrd cannot be read" in capsys.readouterr().err


def test_a_view_is_saved_under_its_own_kind_of_name_and_replaces_nothing_unasked(tmp_path: Path) -> None:
    path = tmp_path / "view.rrd"
    assert saved_as(None, overwrite=False) is None
    assert saved_as(path, overwrite=False) == path
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        saved_as(path, overwrite=False)
    assert saved_as(path, overwrite=True) == path
    with pytest.raises(typer.BadParameter, match=r"ends in \.rrd"):
        saved_as(tmp_path / "view.txt", overwrite=False)


def test_saving_goes_beside_whoever_else_looks(tmp_path: Path) -> None:
    nobody, bench = NullViewer(), Bench(RIG)
    assert saving(nobody, bench, None) is nobody
    with saving(nobody, bench, tmp_path / "view.rrd") as viewers:
        viewers.show(full_moment(0))
    assert (tmp_path / "view.rrd").stat().st_size > 10_000
