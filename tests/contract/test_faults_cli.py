"""`live` on a scene file with faults: it goes on and counts, or ends with one line."""

import json
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from small_frames import SheetNetwork

from nlos_cam.camera import open_camera
from nlos_cam.cli.main import main

PASSING = [
    {"kind": "duplicate", "at_frame": 10, "frames": 3},
    {"kind": "wrong_size", "at_frame": 15},
    {"kind": "all_zero", "at_frame": 20, "frames": 10},
    {"kind": "unplug", "at_frame": 40, "frames": 30},
]
LASTING = [
    {"kind": "duplicate", "at_frame": 10},
    {"kind": "unplug", "at_frame": 20, "frames": 1_000_000},
]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Open cameras with short timeouts for silence and replugging."""

    def opened(uri: str, **options: Any) -> Any:
        camera: Any = open_camera(uri, **options)
        camera.silence_s = 0.5
        camera.replug_s = 2.0
        return camera

    monkeypatch.setattr("nlos_cam.camera.open_camera", opened)
    monkeypatch.setattr("nlos_cam.reconstruct.load_networks", lambda *_: SheetNetwork())
    monkeypatch.setattr("nlos_cam.reconstruct.load_uncertainty", lambda *_: None)


def run(folder: Path, faults: list[dict[str, Any]], *options: str) -> int:
    scene = {"name": "a wall before a poor device", "rig": "bare-wall", "faults": faults}
    (folder / "scene.toml").write_text(tomli_w.dumps(scene), encoding="utf-8")
    return main(["live", "--camera", f"sim:{folder / 'scene.toml'}", "--no-view", *options])


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
def test_live_goes_on_and_counts_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, PASSING, "--seconds", "4", "--json") == 0

    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    seen = {
        "duplicate",
        "wrong_size",
        "incomplete",
        "blank",
        "replugged",
        "dropped_camera",
        "stalls",
    }

    assert seen <= set(report["counts"])
    assert report["stalled_s"] >= 0.9
    assert report["counts"]["replugged"] == 1
    assert 0 < report["counts"]["blank"] <= 10


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
def test_live_ends_with_counts_when_the_device_stays_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, LASTING, "--json") == 3

    captured = capsys.readouterr()
    error = json.loads(captured.out)["error"]

    assert error["type"] == "CameraLostError"
    assert "2 s" in error["message"]

    lines = captured.err.splitlines()
    [seen] = [place for place, line in enumerate(lines) if "1 duplicate" in line]
    [failed] = [place for place, line in enumerate(lines) if line.startswith("error:")]

    assert seen < failed == len(lines) - 1
