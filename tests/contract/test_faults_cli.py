"""`live` on a scene file with faults: the real device, one JSON object, one line where it ends."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.camera import open_camera
from nlos_cam.cli import live as commands
from nlos_cam.cli.main import main

RIG = load_rig("paper-rig")
SCENE = """
name = "a wall before a poor device"
rig = "bare-wall"
"""
PASSING = """
[[faults]]
kind = "duplicate"
at_frame = 10
frames = 3

[[faults]]
kind = "wrong_size"
at_frame = 15

[[faults]]
kind = "all_zero"
at_frame = 20
frames = 10

[[faults]]
kind = "unplug"
at_frame = 40
frames = 30
"""
LASTING = """
[[faults]]
kind = "duplicate"
at_frame = 10

[[faults]]
kind = "unplug"
at_frame = 20
frames = 1_000_000
"""


class FakeNetwork:
    runtime, record = "nothing at all", SimpleNamespace(rig_name=RIG.name, rig_checksum=RIG.checksum, input="raw maps")

    def __call__(self, *_: np.ndarray) -> np.ndarray:
        return np.full((1, 64, 64), 0.5, np.float32)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras that are soon taken for silent, and not waited for long."""

    def opened(uri: str, **options: Any) -> Any:
        camera: Any = open_camera(uri, **options)
        camera.silence_s, camera.replug_s = 0.5, 2.0
        return camera

    monkeypatch.setattr(commands, "open_camera", opened)
    monkeypatch.setattr(commands, "load_networks", lambda *_: FakeNetwork())
    monkeypatch.setattr(commands, "load_doubt", lambda *_: None)


def run(folder: Path, faults: str, *options: str) -> int:
    (folder / "scene.toml").write_text(SCENE + faults, encoding="utf-8")
    return main(["live", "--camera", f"sim:{folder / 'scene.toml'}", "--no-view", *options])


@pytest.mark.usefixtures("impatient")
def test_live_goes_on_and_counts_what_it_saw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, PASSING, "--seconds", "4", "--json") == 0
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    seen = {"duplicate", "wrong_size", "incomplete", "blank", "replugged", "dropped_camera", "stalls"}
    assert seen <= set(report["counts"])
    assert 0.9 <= report["stalled_s"] < 4.0
    assert report["counts"]["replugged"] == 1
    assert 0 < report["counts"]["blank"] <= 10


@pytest.mark.usefixtures("impatient")
def test_a_person_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, PASSING.partition('[[faults]]\nkind = "unplug"')[0], "--seconds", "1") == 0
    [line] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("seen")]
    assert "3 duplicate" in line


@pytest.mark.usefixtures("impatient")
def test_a_device_that_stays_away_ends_it_with_one_line_and_what_was_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, LASTING, "--json") == 3
    captured = capsys.readouterr()
    error = json.loads(captured.out)["error"]
    assert error["type"] == "CameraLostError"
    assert "it was unplugged and did not start within 2 s" in error["message"]
    told = captured.err.splitlines()
    [seen] = [place for place, line in enumerate(told) if line.startswith("seen") and "1 duplicate" in line]
    [failed] = [place for place, line in enumerate(told) if line.startswith("error:")]
    assert seen < failed == len(told) - 1


def test_a_fault_that_cannot_be_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, '[[faults]]\nkind = "explode"\nat_frame = 1\n') == 1
    [line] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert "faults.0.kind" in line
    assert "explode" in line
