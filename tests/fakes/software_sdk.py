"""librealsense with one software lidar in place of what is plugged in."""

from typing import Any

from nlos_calibration import Intrinsics

from nlos_cam.camera import SoftwareLidar, load_sdk


class SoftwareSdk:
    """Stands for pyrealsense2: its context sees the software device of one lidar, and nothing
    else.
    """

    def __init__(self, pinhole: Intrinsics) -> None:
        self.sdk = load_sdk()
        self.lidar = SoftwareLidar(pinhole, self.sdk)
        self._context = self.sdk.context()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.sdk, name)

    def context(self) -> Any:
        return self._context

    def plug_in(self) -> None:
        """Show the device, with the sensors and options that it has by now."""
        self.lidar.device.add_to(self._context)
