"""A live L515's colour on librealsense itself: a software device with both cameras, delivering from a thread."""

import threading
from typing import Any

import numpy as np
from fake_lidar import COLOUR_FROM_DEPTH, LENS
from nlos_calibration.geometry import Intrinsics
from software_colour import SoftwareColour

from nlos_cam.calibrate.color_view import look_in_colour
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.simulated import SoftwareLidar

SMALL = Intrinsics(64, 48, 60.0, 61.0, 33.0, 22.0)
LIDAR_FROM_COLOUR = np.linalg.inv(np.vstack([COLOUR_FROM_DEPTH, [0.0, 0.0, 0.0, 1.0]]))
FRAMES = 4


class Desk:
    """pyrealsense2, whose context sees a software device that is an L515 with a colour camera."""

    def __init__(self) -> None:
        self.sdk = load_sdk()
        self.lidar, self._context = SoftwareLidar(SMALL, self.sdk), self.sdk.context()
        self.colour = SoftwareColour(self.lidar, SMALL, np.array(LENS), LIDAR_FROM_COLOUR)
        self.lidar.device.add_to(self._context)
        self.looked_at, self._stop = 0, threading.Event()
        self._thread = threading.Thread(target=self._deliver, name="colour")
        self._thread.start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.sdk, name)

    def context(self) -> Any:
        return self._context

    def _deliver(self) -> None:
        number = 0
        while not self._stop.wait(0.005):
            if self.colour.sensor.get_active_streams():
                self.colour.push(number, np.full((48, 64, 3), 90, np.uint8))
                number += 1

    def on_frame(self) -> None:
        """A software device must get no frame once it is stopped: with the last one, delivering ends."""
        self.looked_at += 1
        if self.looked_at == FRAMES:
            self.end()

    def end(self) -> None:
        self._stop.set()
        self._thread.join(5.0)


def test_image_lens_and_pose_come_through_librealsense() -> None:
    desk = Desk()
    try:
        view = look_in_colour("l515", FRAMES, sdk=desk, on_frame=desk.on_frame)
    finally:
        desk.end()
    np.testing.assert_array_equal(view.image, np.full((48, 64), 90.0))
    np.testing.assert_allclose(view.distortion, LENS, rtol=1e-6)
    np.testing.assert_allclose(view.lidar_from_camera, LIDAR_FROM_COLOUR, atol=1e-6)
    assert view.intrinsics == SMALL
