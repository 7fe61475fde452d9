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

from nlos_cam.camera import Recording, SimulatedCamera
from nlos_cam.cli import capture
from nlos_cam.cli.capture import final_error, format_take, result_of
from nlos_cam.cli.common import release_outputs
from nlos_cam.cli.main import build_app, main
from nlos_cam.errors import CameraLostError, DiskFullError, OutputExistsError
from nlos_cam.recording import CaptureResult, CaptureTarget, VerifyResult, load_sidecar, verify
from nlos_cam.recording.quality import Quality

Patch = pytest.MonkeyPatch
PROGRAM = """
import sys
from nlos_cam.cli.main import build_app
sys.exit(build_app("capture")(["capture", *sys.argv[1:]], standalone_mode=False) or 0)
"""
Run = Callable[..., dict[str, Any]]


def run_app(*arguments: str) -> int:
    try:
        return build_app("capture")(["capture", *arguments], standalone_mode=False) or 0
    finally:
        release_outputs()


@pytest.fixture
def run(monkeypatch: Patch, capsys: pytest.CaptureFixture[str], noise_world: Any, hurried_clock: Any) -> Run:
    """Run `capture --json` on a NoiseWorld; returns the last line of stdout, and the exit code as "exit"."""

    def open_noise(uri: str, *, on_progress: Any, recording: Recording) -> SimulatedCamera:
        on_progress(1, 1)
        return SimulatedCamera(uri, noise_world(), clock=hurried_clock(), recording=recording)

    def call(*arguments: str) -> dict[str, Any]:
        code = run_app("--camera", "sim", "--json", *arguments)
        return json.loads(capsys.readouterr().out.splitlines()[-1]) | {"exit": code}

    monkeypatch.setattr("nlos_cam.camera.open_camera", open_noise)
    return call


@pytest.fixture
def lines(monkeypatch: Patch) -> list[str]:
    """Collect what the command prints for a person."""
    found: list[str] = []
    monkeypatch.setattr(capture, "say", lambda text, **_: found.append(text))
    return found


@pytest.fixture
def out(tmp_path: Path) -> str:
    return str(tmp_path / "a.bag")


def test_capture_json_reports_the_file(run: Run, tmp_path: Path, out: str, monkeypatch: Patch) -> None:
    found = run("--frames", "9", "--label", "a cup", "--out", out)
    assert (found["frames"], found["dropped"], found["seconds"], found["out"]) == (9, 0, 0.267, out)
    assert (found["exit"], found["state"], found["sidecar"]) == (0, "complete", str(tmp_path / "a.json"))
    assert verify(Path(out)).streams == found["streams"] == {"depth": 9, "infrared": 9, "confidence": 9}
    assert found["label"] == load_sidecar(tmp_path / "a.json").label == "a cup"
    monkeypatch.chdir(tmp_path)
    by_time = run("--seconds", "1")
    assert (by_time["frames"], Path(by_time["out"]).exists()) == (30, True)  # a second of device time, a default name


@pytest.mark.slow
def test_capture_numbers_and_labels_takes(run: Run, tmp_path: Path, out: str) -> None:
    labels = "--label", "a cup", "--label", "a ball", "--label", "a box"
    found = run("--takes", "3", "--frames", "4", *labels, "--out", out)
    assert (found["frames"], found["dropped"], found["exit"]) == (12, 0, 0)
    for number, (take, label) in enumerate(zip(found["takes"], labels[1::2], strict=True), start=1):
        path = tmp_path / f"a-0{number}.bag"
        assert (take["out"], take["label"], take["frames"]) == (str(path), label, 4)
        assert (verify(path).frames, load_sidecar(path.with_suffix(".json")).label) == (4, label)
    found = run("--takes", "2", "--frames", "2", "--label", "cup", "--out", str(tmp_path / "b.bag"))
    assert [take["label"] for take in found["takes"]] == ["cup", "cup"]


@pytest.mark.slow
def test_capture_pauses_between_takes(run: Run, out: str, monkeypatch: Patch) -> None:
    paused: list[float | None] = []
    monkeypatch.setattr(capture, "_pause", lambda _bar, _stop, pause_s, _text: paused.append(pause_s))
    run("--takes", "3", "--frames", "2", "--pause-s", "7", "--out", out)
    assert paused == [7.0, 7.0]


@pytest.mark.parametrize("answer", ["\n", KeyboardInterrupt])
def test_capture_asks_at_a_terminal_before_each_take(run: Run, out: str, monkeypatch: Patch, answer: Any) -> None:
    def readline() -> str:
        if answer is KeyboardInterrupt:
            signal.raise_signal(signal.SIGINT)
        return answer

    monkeypatch.setattr(capture.sys, "stdin", SimpleNamespace(isatty=lambda: True, readline=readline))
    found = run("--takes", "2", "--frames", "2", "--out", out)
    assert found["exit"] == (130 if answer is KeyboardInterrupt else 0)
    assert [take["state"] for take in found["takes"]] == ["complete"] * (1 if answer is KeyboardInterrupt else 2)


@pytest.mark.parametrize(("name", "takes"), [("a.bag", 1), ("a.json", 1), ("a-03.json", 3)])
def test_capture_overwrites_only_with_the_option(run: Run, tmp_path: Path, out: str, name: str, takes: int) -> None:
    precious, options = tmp_path / name, ["--frames", "2", "--out", out, *(["--takes", "3"] if takes > 1 else [])]
    precious.write_text("precious")
    with pytest.raises(OutputExistsError):
        run(*options)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    assert precious.read_text() == "precious"
    assert run(*options, "--overwrite")["frames"] == 2 * takes
    assert load_sidecar(precious.with_suffix(".json")).state == "complete"


def test_capture_checks_disk_space_before_writing(run: Run, tmp_path: Path, out: str, monkeypatch: Patch) -> None:
    monkeypatch.setattr("nlos_cam.camera.free_bytes", lambda _: 210_000_000)
    with pytest.raises(DiskFullError, match=r"1000 .*64 x 48"):
        run("--takes", "2", "--frames", "500", "--out", out)
    assert list(tmp_path.iterdir()) == []
    assert run("--takes", "2", "--frames", "5", "--out", out)["frames"] == 10


def test_capture_without_a_limit_reports_remaining_time(
    run: Run, tmp_path: Path, out: str, monkeypatch: Patch, lines: list[str]
) -> None:
    beside = SimpleNamespace(path=tmp_path / "a.json")
    ended = CaptureResult(CaptureTarget(Path(out)), "interrupted", 0, Quality(), beside)  # before the first frame
    monkeypatch.setattr("nlos_cam.camera.free_bytes", lambda _: 200_000_000 + 64 * 48 * 4 * 30 * 90)
    monkeypatch.setattr("nlos_cam.recording.CaptureSession.record", lambda *_: (one for one in [ended]))
    assert run("--out", out)["exit"] == 130
    assert "at least 90 s" in lines[0]


def test_capture_reports_damage_and_gaps(
    run: Run, tmp_path: Path, out: str, monkeypatch: Patch, lines: list[str]
) -> None:
    monkeypatch.setattr("nlos_cam.recording.verify", lambda *_, **__: VerifyResult(3, 0, 0.1, {}))
    found = run("--frames", "5", "--out", out)
    assert (found["exit"], found["state"], found["error"]["type"]) == (4, "damaged", "RecordingError")
    assert "3 of the 5" in lines[-1]
    lines.clear()
    monkeypatch.setattr("nlos_cam.recording.verify", lambda *_, **__: VerifyResult(5, 2, 0.1, {}))
    assert run("--frames", "5", "--out", str(tmp_path / "b.bag"))["dropped"] == 2
    assert "2 frames" in lines[0]


def test_capture_interrupted_while_reading_back_loses_nothing(run: Run, out: str, monkeypatch: Patch) -> None:
    def interrupted(path: Path, on_frame: Callable[[], None]) -> VerifyResult:
        return verify(path, lambda: (on_frame(), signal.raise_signal(signal.SIGINT))[0])

    monkeypatch.setattr("nlos_cam.recording.verify", interrupted)
    found = run("--frames", "5", "--out", out)
    assert (found["exit"], found["state"], found["frames"]) == (130, "interrupted", None)
    assert verify(Path(out)).frames == 5


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal here")
@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_capture_ended_by_a_signal_loses_no_data(tmp_path: Path, asked: signal.Signals) -> None:
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
    found, report = verify(path), json.loads(stdout)
    assert found.frames == report["frames"] > 0
    assert set(found.streams.values()) == {found.frames}


STREAMS = {"depth": 30, "infrared": 30, "confidence": 30}
LOST = CameraLostError("l515 vanished: replug it")


def take(path: str, **changes: Any) -> CaptureResult:
    """Make a take of 30 frames in a file of 3 MB."""
    Path(path).write_bytes(bytes(3_000_000))
    values = {"state": "complete", "sets": 30, "quality": Quality(30, 0.001, 0.25, 9.0, 1.234, 0.1)}
    values |= {"target": CaptureTarget(Path(path)), "verified": VerifyResult(30, 1, 1.00049, STREAMS)}
    return CaptureResult(**values | {"sidecar": SimpleNamespace(path=Path("a.json"))} | changes)


def test_result_holds_the_fields_of_one_take_and_totals_of_several(out: str) -> None:
    found = result_of([take(out, target=CaptureTarget(Path(out), "a cup"))], several=False)
    shares = {"saturated_share": 0.001, "invalid_share": 0.25, "temporal_noise_mm": 1.234}
    named = {"out": out, "state": "complete", "streams": STREAMS, "sidecar": "a.json", "label": "a cup"}
    assert found == {"frames": 30, "dropped": 1, "seconds": 1.0, **shares, **named}
    found = result_of([take(out), take(out)], several=True)
    assert [one["frames"] for one in found["takes"]] == [30, 30]
    assert (found["frames"], found["dropped"], found["seconds"]) == (60, 2, 2.0)
    assert not {"error", "label"} & found["takes"][0].keys()
    assert result_of([take(out, verified=None)], several=True)["frames"] == 0
    assert result_of([take(out, verified=None)], several=False)["seconds"] is None


def test_error_of_a_take_says_what_is_saved(out: str) -> None:
    lost = take(out, state="lost", error=LOST)
    error = result_of([lost], several=False)["error"]
    assert (error["type"], error["message"]) == ("CameraLostError", str(final_error(lost)))
    assert isinstance(final_error(lost), CameraLostError)
    assert all(word in error["message"] for word in ("l515 vanished: replug it", "30 frames", out))
    assert "frames" not in str(final_error(take(out, state="lost", sets=0, verified=None, error=LOST)))
    full = take(out, state="disk full", verified=None, closed=False, error=DiskFullError("repair it"))
    assert str(final_error(full)) == "repair it"
    assert final_error(take(out, state="interrupted")) is None


def test_lines_at_the_terminal_hold_the_figures(out: str) -> None:
    text = format_take(take(out))
    for word in ("30 frames", "1.0 s", "3 MB", "verified", "0.10 %", "25.0 %", "1.23 mm", out):
        assert word in text
    assert "unknown" in format_take(take(out, quality=Quality(1, 0.0, 0.0)))
    assert "verified" not in format_take(take(out, state="damaged"))
    for changes in ({}, {"verified": None}):
        assert format_take(take(out, state="interrupted", **changes)).startswith("Interrupted. Recorded 30 frames")
    assert format_take(take(out, state="lost", sets=0, verified=None)).startswith("Camera lost before")


@pytest.mark.parametrize("takes", [1, 3])
def test_capture_interrupted_before_start_has_the_same_fields(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Patch, takes: int
) -> None:
    monkeypatch.setattr("nlos_cam.camera.open_camera", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    several = ["--takes", str(takes), "--frames", "2"] if takes > 1 else []
    folder = tmp_path / "empty"
    folder.mkdir()
    assert main(["capture", "--camera", "sim", "--out", str(folder / "a.bag"), "--json", *several]) == 130
    found = json.loads(capsys.readouterr().out)
    assert set(found) == set(result_of([take(str(tmp_path / "b.bag"))], several=takes > 1))
    one = found["takes"][0] if takes > 1 else found
    assert (one["frames"], one["state"], found["frames"]) == (0, "interrupted", 0)
    assert list(folder.iterdir()) == []
