import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from nlos_cam.camera import Recording
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.cli import capture
from nlos_cam.errors import CameraNotFoundError, DiskFullError, NlosCamError, OutputExistsError
from nlos_cam.recording.capture import CaptureResult, CaptureTarget
from nlos_cam.recording.playback import Verified, verify
from nlos_cam.recording.quality import Quality
from nlos_cam.recording.sidecar import load_sidecar

Run = Callable[..., dict[str, Any]]
PROGRAM = """
import sys, typer
from nlos_cam.cli import capture
app = typer.Typer()
capture.register(app)
sys.exit(app(sys.argv[1:], standalone_mode=False) or 0)
"""


def ended_at_once(folder: Path) -> CaptureResult:
    """A take that was interrupted before its first frame."""
    beside = SimpleNamespace(path=folder / "a.json")
    return CaptureResult(CaptureTarget(folder / "a.bag"), "interrupted", 0, Quality(), beside)


def app() -> typer.Typer:
    made = typer.Typer()
    capture.register(made)
    return made


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], noise_world: Any, hurried_clock: Any
) -> Run:
    """Run `capture --json` on a NoiseWorld; returns the last line of stdout, and the exit code as "exit"."""

    def open_noise(uri: str, *, on_progress: Any, recording: Recording) -> SimulatedCamera:
        on_progress(1, 1)
        return SimulatedCamera(uri, noise_world(), clock=hurried_clock(), recording=recording)

    def call(*arguments: str) -> dict[str, Any]:
        code = app()(["--camera", "sim", "--json", *arguments], standalone_mode=False) or 0
        return json.loads(capsys.readouterr().out.splitlines()[-1]) | {"exit": code}

    monkeypatch.setattr(capture, "open_camera", open_noise)
    return call


def test_frames_are_those_in_the_file(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    found = run("--frames", "9", "--out", str(path))
    assert (found["frames"], found["dropped"], found["seconds"], found["out"]) == (9, 0, 0.267, str(path))
    assert (found["exit"], found["state"], found["sidecar"]) == (0, "complete", str(tmp_path / "a.json"))
    assert verify(path).streams == found["streams"] == {"depth": 9, "infrared": 9, "confidence": 9}


def test_seconds_are_the_devices(run: Run, tmp_path: Path) -> None:
    assert run("--seconds", "5", "--out", str(tmp_path / "a.bag"))["frames"] == 150


def test_the_label_is_kept_beside_the_recording(run: Run, tmp_path: Path) -> None:
    assert run("--frames", "2", "--label", "a cup", "--out", str(tmp_path / "a.bag"))["label"] == "a cup"
    assert load_sidecar(tmp_path / "a.json").label == "a cup"


def test_takes_are_numbered_and_labelled(run: Run, tmp_path: Path) -> None:
    labels = "--label", "a cup", "--label", "a ball", "--label", "a box"
    found = run("--takes", "3", "--frames", "4", *labels, "--out", str(tmp_path / "a.bag"))
    assert (found["frames"], found["dropped"], found["exit"]) == (12, 0, 0)
    for number, (take, label) in enumerate(zip(found["takes"], labels[1::2], strict=True), start=1):
        path = tmp_path / f"a-0{number}.bag"
        assert (take["out"], take["label"], take["frames"]) == (str(path), label, 4)
        assert verify(path).frames == 4
        assert load_sidecar(path.with_suffix(".json")).label == label


def test_one_label_is_for_all_takes(run: Run, tmp_path: Path) -> None:
    found = run("--takes", "2", "--frames", "2", "--label", "cup", "--out", str(tmp_path / "a.bag"))
    assert [take["label"] for take in found["takes"]] == ["cup", "cup"]


def test_takes_wait_for_each_other(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paused: list[float | None] = []
    monkeypatch.setattr(capture, "_pause", lambda _bar, _stop, pause_s, _text: paused.append(pause_s))
    run("--takes", "3", "--frames", "2", "--pause-s", "7", "--out", str(tmp_path / "a.bag"))
    assert paused == [7.0, 7.0]


@pytest.mark.parametrize("answer", ["\n", KeyboardInterrupt])
def test_a_person_at_a_terminal_begins_the_next_take_or_ends(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: Any
) -> None:
    def readline() -> str:
        if answer is KeyboardInterrupt:
            signal.raise_signal(signal.SIGINT)
        return answer

    monkeypatch.setattr(capture.sys, "stdin", SimpleNamespace(isatty=lambda: True, readline=readline))
    found = run("--takes", "2", "--frames", "2", "--out", str(tmp_path / "a.bag"))
    assert found["exit"] == (130 if answer is KeyboardInterrupt else 0)
    assert [take["state"] for take in found["takes"]] == ["complete"] * (1 if answer is KeyboardInterrupt else 2)


def test_nothing_is_overwritten_unasked(run: Run, tmp_path: Path) -> None:
    for name in ("a.bag", "a.json"):
        precious = tmp_path / name
        precious.write_text("precious")
        with pytest.raises(OutputExistsError):
            run("--frames", "2", "--out", str(tmp_path / "a.bag"))
        assert [entry.name for entry in tmp_path.iterdir()] == [name]
        assert precious.read_text() == "precious"
        assert run("--frames", "2", "--out", str(tmp_path / "a.bag"), "--overwrite")["frames"] == 2
        assert load_sidecar(tmp_path / "a.json").state == "complete"
        for path in tmp_path.iterdir():
            path.unlink()


def test_no_take_is_begun_where_one_would_overwrite(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a-03.json").write_text("precious")
    with pytest.raises(OutputExistsError):
        run("--takes", "3", "--frames", "2", "--out", str(tmp_path / "a.bag"))
    assert [entry.name for entry in tmp_path.iterdir()] == ["a-03.json"]


def test_the_name_is_dated_if_none_is_given(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Path(run("--frames", "1")["out"]).exists()


@pytest.mark.parametrize(
    "wrong",
    [
        ("--seconds", "1", "--frames", "2"),
        ("--out", "a.mp4"),
        ("--frames", "0"),
        ("--seconds", "0"),
        ("--seconds", "inf"),
        ("--frames", "1", "--takes", "2", "--pause-s", "inf"),
        ("--takes", "2"),
        ("--takes", "3", "--frames", "1", "--label", "a", "--label", "b"),
        ("--frames", "1", "--label", "a", "--label", "b"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(run: Run, wrong: tuple[str, ...]) -> None:
    with pytest.raises(typer.BadParameter):
        run(*wrong)


def test_a_disk_without_room_is_refused_before_anything_is_written(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "free_bytes", lambda _: 210_000_000)
    out = "--out", str(tmp_path / "a.bag")
    with pytest.raises(DiskFullError, match="1000 frames of 64 x 48 may need"):
        run("--takes", "2", "--frames", "500", *out)
    assert list(tmp_path.iterdir()) == []
    assert run("--takes", "2", "--frames", "5", *out)["frames"] == 10


def test_without_a_limit_it_is_told_how_long_there_is_room(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(capture, "say", lambda text, **_: told.append(text))
    monkeypatch.setattr(capture, "free_bytes", lambda _: 200_000_000 + 64 * 48 * 4 * 30 * 90)
    monkeypatch.setattr(capture.Takes, "record", lambda *_: (one for one in [ended_at_once(tmp_path)]))
    assert run("--out", str(tmp_path / "a.bag"))["exit"] == 130
    assert "room for 1.5 minutes or more" in told[0]


def test_an_error_that_ends_a_take_is_told_and_gives_the_exit_code(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(capture, "say", lambda text, **_: told.append(text))
    monkeypatch.setattr(capture, "verify", lambda *_, **__: Verified(3, 0, 0.1, {}))
    found = run("--frames", "5", "--out", str(tmp_path / "a.bag"))
    assert (found["exit"], found["state"], found["error"]["type"]) == (4, "damaged", "RecordingError")
    assert "holds 3 of the 5 frames" in told[-1]


def test_gaps_are_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture, "verify", lambda *_, **__: Verified(5, 2, 0.1, {}))
    told: list[str] = []
    monkeypatch.setattr(capture, "say", lambda text, **_: told.append(text))
    assert run("--frames", "5", "--out", str(tmp_path / "a.bag"))["dropped"] == 2
    assert "2 frames never came" in told[0]


def test_ctrl_c_while_reading_back_loses_nothing(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(path: Path, on_frame: Callable[[], None]) -> Verified:
        return verify(path, lambda: (on_frame(), signal.raise_signal(signal.SIGINT))[0])

    monkeypatch.setattr(capture, "verify", interrupted)
    found = run("--frames", "5", "--out", str(tmp_path / "a.bag"))
    assert (found["exit"], found["state"], found["frames"]) == (130, "interrupted", None)
    assert verify(tmp_path / "a.bag").frames == 5


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
@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_ends_without_loss(tmp_path: Path, asked: signal.Signals) -> None:
    path = tmp_path / "a.bag"
    arguments = ["--camera", "sim:bare-wall", "--json", "--out", str(path)]
    with subprocess.Popen([sys.executable, "-c", PROGRAM, *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            while not (path.with_suffix(".json").exists() and path.stat().st_size > 1_000_000):
                assert process.poll() is None
                time.sleep(0.01)
            process.send_signal(asked)
            stdout, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    beside = load_sidecar(tmp_path / "a.json")
    assert (beside.camera, beside.settings["depth_units"]) == ("sim:bare-wall", pytest.approx(0.00025))
    if asked == signal.SIGKILL:  # what is on the disk can be repaired
        assert (process.returncode, beside.state, stdout) == (-9, "recording", "")
        return
    assert (process.returncode, beside.state) == (130, "interrupted")
    found, told = verify(path), json.loads(stdout)
    assert found.frames == told["frames"] > 0
    assert set(found.streams.values()) == {found.frames}
