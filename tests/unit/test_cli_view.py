import os
import re
import signal
import threading
from collections.abc import Callable
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
from made_up_moments import RIG, Recorded, full_moment

from nlos_cam.cli import live
from nlos_cam.cli import view as live_view
from nlos_cam.cli.main import main
from nlos_cam.cli.view import saving
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.view import web
from nlos_cam.view.rrd_file import RrdFile
from nlos_cam.view.viewer import NullViewer


@pytest.fixture
def saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(web, "page_assets", lambda **_: {"/": ("text/html", b"page")})
    with RrdFile(tmp_path / "view.rrd", RIG) as view:
        view.show(full_moment(0))
    return tmp_path / "view.rrd"


def on_address(monkeypatch: pytest.MonkeyPatch, act: Callable[[str], None]) -> None:
    """Act once the address is told."""

    def say(text: str) -> None:
        act(re.search(r"http://\S+", text)[0])  # type: ignore[index]

    monkeypatch.setattr(live_view, "say", say)


def test_a_saved_view_is_served_until_ctrl_c(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[bytes] = []

    def fetch(address: str) -> None:
        connection = HTTPConnection(urlsplit(address).netloc, timeout=10.0)
        connection.request("GET", "/live.rrd")
        fetched.append(connection.getresponse().read())
        connection.close()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()

    on_address(monkeypatch, fetch)
    assert main(["view", str(saved)]) == 130
    assert fetched == [saved.read_bytes()]


def test_seconds_end_it(saved: Path) -> None:
    assert main(["view", str(saved), "--seconds", "0.1"]) == 0


def test_no_such_file_is_an_unreadable_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "none.rrd")]) == 4
    assert "none.rrd cannot be read" in capsys.readouterr().err


def test_saving_goes_beside_whoever_else_looks(tmp_path: Path) -> None:
    nobody, bench = NullViewer(), CalibratedRig(RIG)
    assert saving(nobody, bench, None) is nobody
    with saving(nobody, bench, tmp_path / "view.rrd") as viewers:
        viewers.show(full_moment(0))
    assert (tmp_path / "view.rrd").stat().st_size > 10_000


class FakeNetwork:
    runtime = "nothing at all"
    record = SimpleNamespace(rig_name=RIG.name, rig_checksum=RIG.checksum, input="raw maps")

    def __call__(self, *_: np.ndarray) -> np.ndarray:
        return np.full((1, 64, 64), 0.5, np.float32)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(live, "open_camera", lambda *_, **__: Recorded(12))
    monkeypatch.setattr(live, "load_networks", lambda *_: FakeNetwork())
    monkeypatch.setattr(live, "load_doubt", lambda *_: None)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("opened")
def test_a_live_view_is_saved_where_asked_for_and_replaces_nothing_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["live", "--camera", "bag:fake", "--no-view", "--save-view", "view.rrd"]
    assert main(arguments) == 0
    assert "nlos-cam view view.rrd" in capsys.readouterr().err
    assert (tmp_path / "view.rrd").stat().st_size > 10_000
    assert main(arguments) == 1
    assert main([*arguments, "--overwrite"]) == 0
    assert main([*arguments[:-1], "view.txt"]) == 2


@pytest.mark.usefixtures("opened")
def test_a_replay_leaves_its_view_stills_and_video_where_asked_for(tmp_path: Path) -> None:
    assert main(["replay", "run.bag", "--out", "out", "--save-view", "--stills", "2", "--video"]) == 0
    made = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"view.rrd", "replay.webm", "still-000000.png"} < made
