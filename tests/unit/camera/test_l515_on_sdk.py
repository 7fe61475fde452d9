import threading
from pathlib import Path
from typing import Any

import numpy as np
from fake_lidar import NapClock
from nlos_calibration.rig import load_rig
from software_sdk import SoftwareSdk

from nlos_cam.camera.l515 import NEAR_WALL, PRESET, L515Camera
from nlos_cam.camera.recorder import Recording
from nlos_cam.recording.playback import ReplayCamera, verify
from nlos_cam.render.sensor.sensor import SensedImages

SATURATES_ABOVE = 60.0
RANGES = dict.fromkeys(NEAR_WALL, (0.0, 6.0)) | {
    "visual_preset": (0.0, 6.0),
    "laser_power": (0.0, 100.0),
}


class Desk(SoftwareSdk):
    def __init__(self) -> None:
        pinhole = load_rig("paper-rig").pinhole
        super().__init__(pinhole)
        for name, (low, high) in RANGES.items():
            self.lidar._sensor.add_option(
                getattr(self.sdk.option, name), self._range(low, high), True
            )
        self.plug_in()
        self.even = np.ones((pinhole.height, pinhole.width), np.uint8)

    def _range(self, low: float, high: float) -> Any:
        made = self.sdk.option_range()
        made.min = low
        made.max = high
        made.step = 1.0
        made.default = high
        return made

    def deliver(self, stop: threading.Event) -> None:
        number = 0
        while not stop.wait(0.03):
            power = self.lidar._sensor.get_option(self.sdk.option.laser_power)
            ir = (255 if power > SATURATES_ABOVE else 48) * self.even
            self.lidar.push(
                number,
                1e9 + number / 30,
                SensedImages(np.uint16(800) * self.even, ir, 15 * self.even),
            )
            number += 1


class Delivering(L515Camera):
    """A software device accepts frames only while it streams."""

    thread: threading.Thread | None = None

    def __init__(self, desk: Desk, recording: Recording) -> None:
        self.desk = desk
        self.stop = threading.Event()
        super().__init__("l515", "", sdk=desk, clock=NapClock(), recording=recording)

    def _prepare(self, sensor: Any) -> None:
        self.thread = threading.Thread(target=self.desk.deliver, args=(self.stop,), name="lidar")
        self.thread.start()
        super()._prepare(sensor)

    def _end(self) -> None:
        self.stop.set()
        if self.thread:
            self.thread.join(5.0)


def test_settings_hold_before_a_recording_by_librealsense(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "wall.bag", frames=20)
    with Delivering(Desk(), recording) as camera:
        settings = list(camera)[-1].settings

    assert set(camera.differences) == {"global_time_enabled"}

    wanted = NEAR_WALL | {"visual_preset": PRESET["visual_preset"], "laser_power": 60.0}

    assert {name: settings[name] for name in wanted} == wanted

    found = verify(recording.path)

    assert found.frames >= recording.sets == 20
    assert found.dropped == 0
    assert found.streams == dict.fromkeys(("depth", "infrared", "confidence"), found.frames)

    with ReplayCamera(recording.path) as replayed:
        frames = list(replayed)

    assert {name: frames[0].settings[name] for name in RANGES} == {
        name: settings[name] for name in RANGES
    }
    assert all(
        frame.ir.max() == 48 for frame in frames
    )  # none from before the laser was turned down
