import json
import re
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
from nlos_cam.cli.capture import final_error, format_take, format_takes, result_of
from nlos_cam.errors import CameraLostError, DiskFullError
from nlos_cam.recording import CaptureResult, CaptureTarget, VerifyResult, load_sidecar, verify
from nlos_cam.recording.quality import Quality

Patch = pytest.MonkeyPatch
Run = Callable[..., Any]
OUT = Path("a.bag")
CAPTURE = "capture", "--camera", "sim", "--out", OUT


@pytest.fixture(autouse=True)
def noise(monkeypatch: Patch, noise_world: Any, hurried_clock: Any) -> None:
    """A NoiseWorld for every camera."""

    def open_noise(uri: str, *, on_progress: Any, recording: Recording) -> SimulatedCamera:
        on_progress(1, 1)
        return SimulatedCamera(uri, noise_world(), clock=hurried_clock(), recording=recording)

    monkeypatch.setattr("nlos_cam.camera.open_camera", open_noise)


@pytest.fixture
def lines(monkeypatch: Patch) -> list[str]:
    """Collect what the command prints for a person."""
    found: list[str] = []
    monkeypatch.setattr(capture.common, "say", lambda text, **_: found.append(text))
    return found


def test_capture_json_reports_the_file(run: Run) -> None:
    found = run(*CAPTURE, "--frames", "9", "--label", "a cup")

    assert found["frames"] == 9
    assert found["dropped"] == 0
    assert found["seconds"] == 0.267
    assert found["out"] == "a.bag"
    assert (found["state"], found["sidecar"]) == ("complete", "a.json")
    assert verify(OUT).streams == found["streams"] == {"depth": 9, "infrared": 9, "confidence": 9}
    assert found["label"] == load_sidecar(Path("a.json")).label == "a cup"

    by_time = run("capture", "--seconds", "1")

    assert (by_time["frames"], Path(by_time["out"]).exists()) == (
        30,
        True,
    )  # a second of device time, a default name


@pytest.mark.slow
def test_capture_numbers_and_labels_takes_and_pauses_between(
    run: Run, monkeypatch: Patch, lines: list[str]
) -> None:
    paused: list[float | None] = []
    monkeypatch.setattr(
        capture, "_pause", lambda _bar, _stop, pause_s, _text: paused.append(pause_s)
    )
    labels = "--label", "a cup", "--label", "a ball", "--label", "a box"
    found = run(*CAPTURE, "--takes", "3", "--frames", "4", "--pause-s", "7", *labels)

    assert found["frames"] == 12
    assert found["dropped"] == 0
    assert paused == [7.0, 7.0]
    assert [line.split()[-1] for line in lines] == ["a-01.bag", "a-02.bag", "a-03.bag"]

    for number, (take, label) in enumerate(zip(found["takes"], labels[1::2], strict=True), start=1):
        path = Path(f"a-0{number}.bag")
        assert (take["out"], take["label"], take["frames"]) == (str(path), label, 4)
        assert (verify(path).frames, load_sidecar(path.with_suffix(".json")).label) == (4, label)
    found = run("capture", "--takes", "2", "--frames", "2", "--label", "cup", "--out", "b.bag")

    assert [take["label"] for take in found["takes"]] == ["cup", "cup"]


@pytest.mark.parametrize(("answer", "code", "takes"), [("\n", 0, 2), (KeyboardInterrupt, 130, 1)])
def test_terminal_is_asked_before_each_take(
    run: Run, monkeypatch: Patch, answer: Any, code: int, takes: int
) -> None:
    def readline() -> str:
        if answer is KeyboardInterrupt:
            signal.raise_signal(signal.SIGINT)
        return answer

    monkeypatch.setattr(
        capture.sys, "stdin", SimpleNamespace(isatty=lambda: True, readline=readline)
    )
    found = run(*CAPTURE, "--takes", "2", "--frames", "2", code=code)

    assert [take["state"] for take in found["takes"]] == ["complete"] * takes


@pytest.mark.parametrize(("name", "takes"), [("a.bag", 1), ("a.json", 1), ("a-03.json", 3)])
def test_capture_overwrites_only_with_the_option(run: Run, name: str, takes: int) -> None:
    (precious := Path(name)).write_text("precious")
    command = *CAPTURE, "--frames", "2", *(["--takes", "3"] if takes > 1 else [])

    assert run(*command, code=1)["error"]["type"] == "OutputExistsError"
    assert list(Path().iterdir()) == [precious]
    assert precious.read_text() == "precious"
    assert run(*command, "--overwrite")["frames"] == 2 * takes
    assert load_sidecar(precious.with_suffix(".json")).state == "complete"


def test_capture_checks_disk_space_before_writing(run: Run, monkeypatch: Patch) -> None:
    monkeypatch.setattr("nlos_cam.camera.free_bytes", lambda _: 210_000_000)
    error = run(*CAPTURE, "--takes", "2", "--frames", "500", code=1)["error"]

    assert error["type"] == "DiskFullError"
    assert re.search("1000 .*64 x 48", error["message"])
    assert list(Path().iterdir()) == []
    assert run(*CAPTURE, "--takes", "2", "--frames", "5")["frames"] == 10


def test_capture_without_a_limit_reports_remaining_time(
    run: Run, monkeypatch: Patch, lines: list[str]
) -> None:
    beside = SimpleNamespace(path=Path("a.json"))
    ended = CaptureResult(
        CaptureTarget(OUT), "interrupted", 0, Quality(), beside
    )  # before the first frame
    monkeypatch.setattr("nlos_cam.camera.free_bytes", lambda _: 204_100_000 + 64 * 48 * 4 * 30 * 90)
    monkeypatch.setattr(
        "nlos_cam.recording.CaptureSession.record", lambda *_: (one for one in [ended])
    )
    run(*CAPTURE, code=130)

    assert "at least 90 s" in lines[0]


def test_capture_reports_damage_and_gaps(run: Run, monkeypatch: Patch, lines: list[str]) -> None:
    monkeypatch.setattr("nlos_cam.recording.verify", lambda *_, **__: VerifyResult(3, 0, 0.1, {}))
    found = run(*CAPTURE, "--frames", "5", code=4)

    assert found["state"] == "damaged"
    assert found["error"]["type"] == "RecordingError"
    assert "3 of the 5" in lines[-1]

    lines.clear()
    monkeypatch.setattr("nlos_cam.recording.verify", lambda *_, **__: VerifyResult(5, 2, 0.1, {}))

    assert run(*CAPTURE, "--frames", "5", "--overwrite")["dropped"] == 2
    assert "2 frames" in lines[0]


def test_capture_interrupted_while_reading_back_loses_nothing(run: Run, monkeypatch: Patch) -> None:
    def interrupted(path: Path, on_frame: Callable[[], None]) -> VerifyResult:
        return verify(path, lambda: (on_frame(), signal.raise_signal(signal.SIGINT))[0])

    monkeypatch.setattr("nlos_cam.recording.verify", interrupted)
    found = run(*CAPTURE, "--frames", "5", code=130)

    assert (found["state"], found["frames"]) == ("interrupted", None)
    assert verify(OUT).frames == 5


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal here")
@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_capture_ended_by_a_signal_loses_no_data(asked: signal.Signals) -> None:
    program = [sys.executable, "-c", "from nlos_cam.cli import run; run()"]
    command = [*program, "capture", "sim:bare-wall", "--json", "--out", "a.bag"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            while not (Path("a.json").exists() and OUT.stat().st_size > 1_000_000):
                assert process.poll() is None
                time.sleep(0.01)
            process.send_signal(asked)
            stdout, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    beside = load_sidecar(Path("a.json"))

    assert beside.camera == "sim:bare-wall"
    assert beside.settings["depth_units"] == pytest.approx(0.00025)

    if asked == signal.SIGKILL:  # what is on the disk can be repaired
        assert (process.returncode, beside.state, stdout) == (-9, "recording", "")
        return

    assert process.returncode == 130
    assert beside.state == "interrupted"

    found = verify(OUT)
    report = json.loads(stdout)

    assert found.frames == report["frames"] > 0
    assert set(found.streams.values()) == {found.frames}


STREAMS = {"depth": 30, "infrared": 30, "confidence": 30}
LOST = CameraLostError("l515 vanished: replug it")


def take(**changes: Any) -> CaptureResult:
    """Make a take of 30 frames in a file of 3 MB."""
    OUT.write_bytes(bytes(3_000_000))
    values = {"state": "complete", "sets": 30, "quality": Quality(30, 0.001, 0.25, 9.0, 1.234, 0.1)}
    values |= {"target": CaptureTarget(OUT), "verified": VerifyResult(30, 1, 1.00049, STREAMS)}
    return CaptureResult(**values | {"sidecar": SimpleNamespace(path=Path("a.json"))} | changes)


def test_result_holds_fields_of_one_take_totals_of_several() -> None:
    found = result_of([take(target=CaptureTarget(OUT, "a cup"))], several=False)
    shares = {"saturated_share": 0.001, "invalid_share": 0.25, "temporal_noise_mm": 1.234}
    named = {
        "out": "a.bag",
        "state": "complete",
        "streams": STREAMS,
        "sidecar": "a.json",
        "label": "a cup",
    }

    assert found == {"frames": 30, "dropped": 1, "seconds": 1.0, **shares, **named}

    found = result_of([take(), take()], several=True)

    assert [one["frames"] for one in found["takes"]] == [30, 30]
    assert found["frames"] == 60
    assert found["dropped"] == 2
    assert found["seconds"] == 2.0
    assert not {"error", "label"} & found["takes"][0].keys()
    assert result_of([take(verified=None)], several=True)["frames"] == 0
    assert result_of([take(verified=None)], several=False)["seconds"] is None


def test_error_of_a_take_says_what_is_saved() -> None:
    lost = take(state="lost", error=LOST)
    error = result_of([lost], several=False)["error"]

    assert error["type"] == "CameraLostError"
    assert error["message"] == str(final_error(lost))
    assert isinstance(final_error(lost), CameraLostError)
    assert all(
        word in error["message"] for word in ("l515 vanished: replug it", "30 frames", "a.bag")
    )
    assert "frames" not in str(final_error(take(state="lost", sets=0, verified=None, error=LOST)))

    full = take(state="disk full", verified=None, closed=False, error=DiskFullError("repair it"))

    assert str(final_error(full)) == "repair it"
    assert final_error(take(state="interrupted")) is None


def test_lines_at_the_terminal_hold_the_figures() -> None:
    text = format_take(take())
    for word in ("30 frames", "1.0 s", "3 MB", "verified", "0.10 %", "25.0 %", "1.23 mm", "a.bag"):
        assert word in text

    targets = [CaptureTarget(OUT)] * 3
    assert format_takes([take()], targets[:1]) == text
    unread = take(state="interrupted", verified=None)
    assert format_takes([take(), unread], targets) == "Recorded 2 of 3 takes, 30 frames in all"
    assert format_takes([take(), take()], targets) == "Recorded 2 of 3 takes, 60 frames in all"
    assert "unknown" in format_take(take(quality=Quality(1, 0.0, 0.0)))
    assert "verified" not in format_take(take(state="damaged"))

    for changes in ({}, {"verified": None}):
        assert format_take(take(state="interrupted", **changes)).startswith(
            "Interrupted. Recorded 30 frames"
        )

    assert format_take(take(state="lost", sets=0, verified=None)).startswith("Camera lost before")


@pytest.mark.parametrize("several", [[], ["--takes", "3", "--frames", "2"]])
def test_capture_interrupted_before_start_has_the_same_fields(
    run: Run, monkeypatch: Patch, several: list[str]
) -> None:
    monkeypatch.setattr(
        "nlos_cam.camera.open_camera", lambda *_, **__: signal.raise_signal(signal.SIGINT)
    )
    found = run(*CAPTURE, *several, code=130)

    assert list(Path().iterdir()) == []
    assert set(found) == set(result_of([take()], several=bool(several)))

    one = found["takes"][0] if several else found

    assert one["frames"] == 0
    assert one["state"] == "interrupted"
    assert found["frames"] == 0
