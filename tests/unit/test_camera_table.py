import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.camera import SIMULATED, open_camera
from nlos_cam.errors import CameraNotFoundError, RecordingError, SceneError

LATE = """
import sys
from nlos_cam.camera import open_camera
print(*(name for name in ("pyrealsense2", "nlos_cam.camera.l515", "nlos_cam.camera.world") if name in sys.modules))
"""


@pytest.mark.parametrize("uri", ["", "webcam", "bag", "bag:", "L515", "/dev/video0", "sims"])
def test_an_unknown_name_is_told_with_the_known_ones(uri: str) -> None:
    with pytest.raises(CameraNotFoundError, match=r"use l515, l515:SERIAL, sim, sim:bare-wall") as raised:
        open_camera(uri)
    assert repr(uri) in str(raised.value)


def test_a_scene_that_is_not_there_is_a_scene_error() -> None:
    with pytest.raises(SceneError, match="nowhere"):
        open_camera("sim:nowhere.toml")


def test_a_recording_that_is_not_there_is_a_recording_error() -> None:
    with pytest.raises(RecordingError, match="nowhere"):
        open_camera("bag:nowhere.bag")


@pytest.mark.parametrize(("reader", "kind"), [("plain", "ReplayCamera"), ("sdk", "SdkReplayCamera")])
def test_a_recording_is_read_by_who_is_asked_to(noise_bag: Path, reader: Any, kind: str) -> None:
    assert type(open_camera(f"bag:{noise_bag}", reader=reader)).__name__ == kind


def test_a_colon_may_be_part_of_a_path(noise_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "a:b.bag"
    path.write_bytes(noise_bag.read_bytes())
    assert open_camera(f"bag:{path}").uri == f"bag:{path}"


def test_the_packaged_worlds_can_be_opened() -> None:
    for uri in SIMULATED:
        assert open_camera(uri).uri == uri


def test_rendering_ahead_tells_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    told: list[tuple[int, int]] = []
    open_camera("sim:bare-wall", on_progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 1)]


def test_backends_are_not_imported_before_they_are_asked_for() -> None:
    ended = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, check=True, timeout=120)
    assert ended.stdout.strip() == ""
