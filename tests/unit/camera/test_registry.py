import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.camera import SIMULATED, open_camera
from nlos_cam.errors import CameraNotFoundError

LATE = """
import sys
from nlos_cam.camera import open_camera
print(*sys.modules.keys() & {"pyrealsense2", "nlos_cam.camera.l515", "nlos_cam.camera.simulated_world"})
"""


@pytest.mark.parametrize("uri", ["", "webcam", "bag", "bag:", "L515", "/dev/video0", "sims"])
def test_unknown_camera_is_an_error_with_the_known_ones(uri: str) -> None:
    with pytest.raises(CameraNotFoundError, match=r"l515, l515:SERIAL, sim, sim:bare-wall") as raised:
        open_camera(uri)
    assert repr(uri) in str(raised.value)


@pytest.mark.parametrize(("reader", "kind"), [("plain", "ReplayCamera"), ("sdk", "SdkReplayCamera")])
def test_reader_and_path_choose_the_playback(noise_bag: Path, tmp_path: Path, reader: Any, kind: str) -> None:
    path = tmp_path / "a:b.bag"
    path.write_bytes(noise_bag.read_bytes())
    camera = open_camera(f"bag:{path}", reader=reader)
    assert (type(camera).__name__, camera.uri) == (kind, f"bag:{path}")


def test_worlds_can_be_opened_and_report_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for uri in SIMULATED:
        assert open_camera(uri).uri == uri
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    monkeypatch.setattr("nlos_cam.camera.simulated_world.WORLDS", tmp_path)
    progress: list[tuple[int, int]] = []
    open_camera("sim:bare-wall", on_progress=lambda done, total: progress.append((done, total)))
    assert progress == [(1, 1)]


def test_backends_are_imported_late() -> None:
    ended = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, check=True, timeout=120)
    assert ended.stdout.strip() == ""
