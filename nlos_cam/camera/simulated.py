"""The simulated L515: a rendered world with a thin device in front of it."""

from threading import Event, Thread
from typing import Any

from nlos_calibration.rig import Rig

from nlos_cam.camera.clock import Clock, WallClock
from nlos_cam.camera.inbox import Inbox
from nlos_cam.camera.live_camera import LiveCamera
from nlos_cam.camera.record import Recording
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.software_lidar import SoftwareLidar
from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.camera.world import World
from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Float32

MOST_LATE = FRAMES_PER_S
"""Frames that a world may deliver late, when the machine is busy; beyond that it drops numbers."""
JOIN_TIMEOUT_S = 5.0


class SimulatedCamera(LiveCamera):
    """A world seen through librealsense's software device, 30 frames/s.

    The device does not model: start-up and warm-up, options (depth units apart) and presets, other resolutions, the
    colour camera and the motion sensors, per-frame metadata, clock drift and jitter, USB errors and lost frames. The
    world's docstrings say what the images do not model.
    """

    def __init__(
        self,
        uri: str,
        world: World,
        *,
        clock: Clock | None = None,
        recording: Recording | None = None,
    ) -> None:
        self._world, self._clock = world, clock or WallClock()
        world.images(0)  # compiles, which would make the first frames late
        self._stopping = Event()
        self._thread: Thread | None = None
        pinhole, sdk = world.rig.pinhole, load_sdk()
        self._lidar = SoftwareLidar(pinhole, sdk)
        super().__init__(uri, self._lidar.device, (pinhole.width, pinhole.height), sdk, recording, self._clock)
        self.rig: Rig | None = world.rig

    def _prepare(self, sensor: Any) -> None:
        """Nothing to set."""

    def _begin(self, inbox: Inbox) -> None:
        self._stopping.clear()
        self._thread = Thread(target=self._run, args=(inbox,), name=f"world of {self.uri}", daemon=True)
        self._thread.start()

    def _end(self) -> None:
        self._stopping.set()
        if self._thread is None:
            return
        self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive():
            raise CameraLostError(f"{self.uri} did not stop within {JOIN_TIMEOUT_S:.0f} s")
        self._thread = None

    def _truth_depth_m(self, number: int) -> Float32 | None:
        return self._world.truth_depth_m(number)

    def _run(self, inbox: Inbox) -> None:
        try:
            self._deliver()
        except Exception as error:  # noqa: BLE001  whatever it is, it is for the consumer's thread
            inbox.fail(error)

    def _deliver(self) -> None:
        """Expose each frame ahead, and push it when it is due."""
        number, start_s = 0, self._clock.now()
        while True:
            images, due_s = self._world.images(number), start_s + number / FRAMES_PER_S
            if self._clock.wait(self._stopping, due_s - self._clock.now()):
                return
            self._lidar.push(number, due_s, images)
            late = int((self._clock.now() - start_s) * FRAMES_PER_S) - number
            number += max(1, late - MOST_LATE)
