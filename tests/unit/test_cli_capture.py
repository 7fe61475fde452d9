import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from nlos_cam.camera import Recording
from nlos_cam.camera.replay import Verified, verify
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.cli import capture
from nlos_cam.errors import CameraNotFoundError, NlosCamError, OutputExistsError, RecordingError

Run = Callable[..., dict[str, Any]]
PROGRAM = """
import sys, typer
from nlos_cam.cli import capture
app = typer.Typer()
capture.register(app)
sys.exit(app(sys.argv[1:], standalone_mode=False) or 0)
"""


def app() -> typer.Typer:
    made = typer.Typer()
    capture.register(made)
    return made


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], noise_world: Any, hurried_clock: Any
) -> Run:
    """Run `capture --json` on a NoiseWorld; returns the last line of stdout."""

    def open_noise(uri: str, *, on_progress: Any, recording: Recording) -> SimulatedCamera:
        on_progress(1, 1)
        return SimulatedCamera(uri, noise_world(), clock=hurried_clock(), recording=recording)

    def call(*arguments: str) -> dict[str, Any]:
        app()(["--camera", "sim", "--json", *arguments], standalone_mode=False)
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    monkeypatch.setattr(capture, "open_camera", open_noise)
    return call


def test_frames_are_those_in_the_file(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    assert run("--frames", "9", "--out", str(path)) == {"frames": 9, "dropped": 0, "seconds": 0.267, "out": str(path)}
    assert verify(path).streams == {"depth": 9, "infrared": 9, "confidence": 9}


def test_seconds_are_the_devices(run: Run, tmp_path: Path) -> None:
    assert run("--seconds", "5", "--out", str(tmp_path / "a.bag"))["frames"] == 150


def test_the_label_is_kept_beside_the_recording(run: Run, tmp_path: Path) -> None:
    assert run("--frames", "2", "--label", "a cup", "--out", str(tmp_path / "a.bag"))["label"] == "a cup"
    assert json.loads((tmp_path / "a.json").read_text()) == {"label": "a cup", "camera": "sim"}


def test_nothing_is_overwritten_unasked(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_text("precious")
    with pytest.raises(OutputExistsError):
        run("--frames", "2", "--out", str(path))
    assert path.read_text() == "precious"
    assert run("--frames", "2", "--out", str(path), "--overwrite")["frames"] == 2


def test_a_label_file_is_not_overwritten_unasked(run: Run, tmp_path: Path) -> None:
    note = tmp_path / "a.json"
    note.write_text("precious")
    with pytest.raises(OutputExistsError):
        run("--frames", "2", "--label", "cup", "--out", str(tmp_path / "a.bag"))
    assert not (tmp_path / "a.bag").exists()
    run("--frames", "2", "--out", str(tmp_path / "a.bag"))
    assert note.read_text() == "precious"


def test_the_label_of_a_replaced_recording_goes_with_it(run: Run, tmp_path: Path) -> None:
    arguments = "--frames", "2", "--overwrite", "--out", str(tmp_path / "a.bag")
    run(*arguments, "--label", "cup")
    run(*arguments)
    assert not (tmp_path / "a.json").exists()


def test_the_name_is_dated_if_none_is_given(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Path(run("--frames", "1")["out"]).exists()


@pytest.mark.parametrize(
    "wrong", [("--seconds", "1", "--frames", "2"), ("--out", "a.mp4"), ("--frames", "0"), ("--seconds", "0")]
)
def test_arguments_that_make_no_sense_are_refused(run: Run, wrong: tuple[str, ...]) -> None:
    with pytest.raises(typer.BadParameter):
        run(*wrong)


def test_a_file_that_holds_less_than_came_is_an_error(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "verify", lambda _: Verified(3, 0, 0.1, {}))
    with pytest.raises(RecordingError, match="holds 3 of the 5 frames"):
        run("--frames", "5", "--out", str(tmp_path / "a.bag"))


def test_gaps_are_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture, "verify", lambda _: Verified(5, 2, 0.1, {}))
    told: list[str] = []
    monkeypatch.setattr(capture, "say", told.append)
    assert run("--frames", "5", "--out", str(tmp_path / "a.bag"))["dropped"] == 2
    assert "2 frames never came" in told[0]


@pytest.mark.parametrize(
    ("uri", "error"), [("bag", NlosCamError), ("webcam", CameraNotFoundError), ("bag:nowhere.bag", NlosCamError)]
)
def test_what_cannot_be_captured_leaves_no_file(
    noise_bag: Path, tmp_path: Path, uri: str, error: type[Exception]
) -> None:
    camera = f"bag:{noise_bag}" if uri == "bag" else uri
    with pytest.raises(error):
        app()(["--camera", camera, "--out", str(tmp_path / "a.bag")], standalone_mode=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal here")
def test_ctrl_c_ends_without_loss(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    arguments = ["--camera", "sim:bare-wall", "--json", "--out", str(path)]
    with subprocess.Popen([sys.executable, "-c", PROGRAM, *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            while not (path.exists() and path.stat().st_size > 1_000_000):
                assert process.poll() is None
                time.sleep(0.01)
            process.send_signal(signal.SIGINT)
            stdout, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130
    found, told = verify(path), json.loads(stdout)
    assert found.frames == told["frames"] > 0
    assert set(found.streams.values()) == {found.frames}
