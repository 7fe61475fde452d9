"""A SoftwareLidar in front of a program, a colour camera beside it in the same device, and
recordings of both.
"""

import gc
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import Intrinsics
from numpy.typing import NDArray

from nlos_cam.camera import FRAMES_PER_S, SoftwareLidar, load_sdk
from nlos_cam.render import SensedImages


class SoftwareSdk:
    """Stands for pyrealsense2: its context sees the software device of one lidar, and nothing
    else.
    """

    def __init__(self, pinhole: Intrinsics) -> None:
        self.sdk = load_sdk()
        self.lidar, self._context = SoftwareLidar(pinhole, self.sdk), self.sdk.context()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.sdk, name)

    def context(self) -> Any:
        return self._context

    def plug_in(self) -> None:
        """Show the device, with the sensors and options that it has by now."""
        self.lidar.device.add_to(self._context)


BYTES_PER_PIXEL = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "yuyv": 2, "uyvy": 2}


class SoftwareColour:
    """The L515's RGB sensor as librealsense sees it: delivers what is pushed into it while it
    streams.
    """

    def __init__(
        self,
        lidar: SoftwareLidar,
        pinhole: Intrinsics,
        lens: NDArray[np.float64],
        lidar_from_colour: NDArray[np.float64],
        form: str = "rgb8",
    ) -> None:
        self._sdk = load_sdk()
        self._bytes = BYTES_PER_PIXEL[form]
        self.sensor: Any = lidar.device.add_sensor("RGB Camera")
        made = self._sdk.video_stream()
        made.type = self._sdk.stream.color
        made.index = 0
        made.uid = 100
        made.width = pinhole.width
        made.height = pinhole.height
        made.fps = FRAMES_PER_S
        made.bpp = self._bytes
        made.fmt = getattr(self._sdk.format, form)
        made.intrinsics = lidar._sdk_intrinsics(pinhole)
        made.intrinsics.model = self._sdk.distortion.brown_conrady
        made.intrinsics.coeffs = lens.tolist()
        self.profile: Any = self._sdk.video_stream_profile(self.sensor.add_video_stream(made, True))
        for other in lidar._profiles.values():
            self.profile.register_extrinsics_to(other, self._extrinsics(lidar_from_colour))
            other.register_extrinsics_to(
                self.profile, self._extrinsics(np.linalg.inv(lidar_from_colour))
            )

    def _extrinsics(self, pose: NDArray[np.float64]) -> Any:
        made = self._sdk.extrinsics()
        made.rotation = pose[:3, :3].T.ravel().tolist()
        made.translation = pose[:3, 3].tolist()
        return made

    def push(self, number: int, pixels: NDArray[np.uint8]) -> None:
        """Deliver one frame, only while the sensor streams: as many bytes per pixel as its format
        has.
        """
        frame = (
            self._sdk.software_video_frame()
        )  # a new one each time: a pushed frame belongs to the SDK
        frame.pixels = np.ascontiguousarray(pixels)
        frame.bpp = self._bytes
        frame.stride = pixels.shape[1] * self._bytes
        frame.timestamp = 1e12 + number * 1e3 / FRAMES_PER_S
        frame.frame_number = number
        frame.domain = self._sdk.timestamp_domain.global_time
        frame.profile = self.profile
        self.sensor.on_video_frame(frame)


def record_with_colour(
    path: Path,
    lidar: SoftwareLidar,
    colour: SoftwareColour,
    images: list[SensedImages],
    seen: list[NDArray[np.uint8]],
) -> Path:
    """A recording of depth, infrared and confidence, then of colour, as librealsense writes it."""
    recorder = load_sdk().recorder(str(path), lidar.device)
    for sensor in (lidar._sensor, colour.sensor):
        sensor.open(sensor.get_stream_profiles())
        sensor.start(lambda _: None)
    for number, instant in enumerate(images):
        lidar.push(number, 1e9 + number / FRAMES_PER_S, instant)
    for number, pixels in enumerate(seen):
        colour.push(number, pixels)
    recorder.pause()  # what came is written before this returns
    for sensor in (lidar._sensor, colour.sensor):
        sensor.stop()
        sensor.close()
    del recorder
    gc.collect()
    return path
