"""What becomes of a recording when its device falls silent, through librealsense's own recorder where it matters."""

from collections.abc import Callable
from itertools import islice, pairwise
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from fake_lidar import FakeLidar

from nlos_cam.camera.live_camera import LiveCamera
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.errors import CameraLostError
from nlos_cam.recording.playback import verify
from nlos_cam.render.scene_file import Fault

Make = Callable[..., Any]
UNPLUGGED = Fault(kind="unplug", at_frame=15, frames=2000)
STALLED = Fault(kind="stall", at_frame=15, frames=2000)


@pytest.fixture
def simulated(noise_world: Make, hurried_clock: Any) -> Callable[[Recording, Fault], LiveCamera]:
    class Impatient(hurried_clock):
        """The world waits for its next frame only; whoever waits longer waits until the fault is over."""

        def wait(self, stop: Event, seconds: float) -> bool:
            return super().wait(stop, seconds if seconds < 0.2 else 100.0)

    def make(recording: Recording, fault: Fault) -> LiveCamera:
        camera = SimulatedCamera("sim", noise_world(), clock=Impatient(), recording=recording, faults=[fault])
        camera.silence_s, camera.replug_s = 0.5, 1000.0
        return camera

    return make


@pytest.mark.parametrize("fault", [UNPLUGGED, STALLED], ids=["unplug", "stall"])
def test_an_optional_recording_ends_whole_and_the_camera_goes_on(
    simulated: Make, fault: Fault, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recording = Recording(tmp_path / "run.bag", optional=True)
    with simulated(recording, fault) as camera:
        numbers = [frame.frame_number for frame in islice(camera, 40)]
        assert camera.counts["replugged"] + camera.counts["restarted"] > 0
        found = verify(recording.path)  # readable while the camera goes on
    assert all(one < next_one for one, next_one in pairwise(numbers))
    assert found.frames == recording.sets > 0
    assert found.dropped == 0
    assert f"the recording ends there, whole, after {recording.sets} frames" in caplog.text


@pytest.mark.parametrize("fault", [UNPLUGGED, STALLED], ids=["unplug", "stall"])
def test_the_end_of_a_recording_that_is_needed_is_an_error_and_the_file_is_whole(
    simulated: Make, fault: Fault, tmp_path: Path
) -> None:
    recording = Recording(tmp_path / "run.bag", frames=1000)
    with (
        pytest.raises(CameraLostError, match=r"the recording ends there, whole"),
        simulated(recording, fault) as camera,
    ):
        list(camera)
    assert not camera.counts["replugged"]
    assert verify(recording.path).frames == recording.sets > 0


def test_a_recording_without_a_frame_begins_anew_with_the_streams(fake_camera: Make, tmp_path: Path) -> None:
    lidar, recording = FakeLidar(usb="2.1", runs=(0, 10**6)), Recording(tmp_path / "run.bag", frames=5)
    with fake_camera(lidar, recording=recording) as camera:
        camera.silence_s = 0.3
        assert len(list(camera)) == recording.sets == 5
        assert camera.counts == {"restarted": 1}
    assert [did for did in lidar.did if did in {"start", "record", "stop"}] == ["start", "record", "stop"] * 2


def test_a_recording_begins_when_the_settings_hold(fake_camera: Make, tmp_path: Path) -> None:
    lidar = FakeLidar(usb="2.1", runs=(10**6,), laser_power=93.0)
    lidar.saturated_share = lambda power: 0.3 if power > 60 else 0.0
    recording = Recording(tmp_path / "run.bag", frames=5)
    with fake_camera(lidar, recording=recording) as camera:
        assert len(list(camera)) == 5
    assert lidar.did.index("record") > max(at for at, did in enumerate(lidar.did) if did in lidar.options)
