"""What only a real L515 can show.

The bench: one L515 (firmware 1.5.8.1) on USB 3, 0.2 m from a bare matt white wall, turned 45 degrees to it, nothing
else within 1 m; no other program using it. Run with `pytest -m hardware`; every test skips where no L515 is connected.
"""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from nlos_cam.camera import Camera, Recording, open_camera
from nlos_cam.camera.l515 import NEAR_WALL, list_devices
from nlos_cam.camera.replay import verify

pytestmark = pytest.mark.hardware
SECONDS = 5


@pytest.fixture
def camera() -> Camera:
    if not any("L515" in info.name for info in list_devices()):
        pytest.skip("no L515 is connected")
    return open_camera("l515")


def test_five_seconds_come_without_a_gap(camera: Camera) -> None:
    with camera:
        frames = list(islice(camera, 30 * SECONDS))
    assert (camera.dropped, camera.incomplete) == (0, 0)
    assert frames[-1].timestamp_s - frames[0].timestamp_s == pytest.approx(SECONDS, abs=0.1)


def test_near_wall_settings_are_taken(camera: Camera) -> None:
    with camera:
        settings = next(iter(camera)).settings
    assert {name: settings[name] for name in NEAR_WALL} == NEAR_WALL


def test_the_wall_is_seen_near_and_unsaturated(camera: Camera) -> None:
    with camera:
        frame = list(islice(camera, 30))[-1]
    assert 0.1 < np.nanmedian(frame.depth_m) < 1.5
    assert np.count_nonzero(~np.isnan(frame.depth_m)) > 0.5 * frame.depth_m.size
    assert np.count_nonzero(frame.ir == 255) < 0.001 * frame.ir.size


@pytest.mark.usefixtures("camera")
def test_a_recording_holds_every_frame(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "wall.bag", seconds=SECONDS)
    with open_camera("l515", recording=recording) as source:
        seen = list(source)
    found = verify(recording.path)
    assert found.frames >= recording.sets == len(seen)
    assert found.dropped == 0


@pytest.mark.usefixtures("camera")
def test_it_can_be_found_by_its_serial_number() -> None:
    [serial] = [info.serial for info in list_devices() if "L515" in info.name]
    with open_camera(f"l515:{serial}") as source:
        next(iter(source))
