"""A lidar that librealsense takes for a device, and that delivers what is pushed into it."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from nlos_calibration.projection import Intrinsics
from numpy.typing import NDArray

from nlos_cam.camera.streams import BYTES_PER_PIXEL, FORMATS, FRAMES_PER_S
from nlos_cam.render.sensor import DEPTH_UNIT_M, SensedImages

NAME, SERIAL = "Simulated L515", "simulated"
SENSOR_NAME = "L500 Depth Sensor"


class SoftwareLidar:
    """An `rs.software_device` with the L515's depth sensor: same sensor name, streams, formats and depth unit.

    It streams at one size; one that `has_other_size` can also be made to deliver frames of half the rows and columns.
    Its timestamps are the host's time, unless it `has_own_clock`. Its options are its depth unit and the temperatures
    `celsius`, by the SDK's names, which stay as they are given.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        sdk: Any,
        *,
        celsius: Mapping[str, float] | None = None,
        has_other_size: bool = False,
        has_own_clock: bool = False,
    ) -> None:
        self._sdk = sdk
        domains = sdk.timestamp_domain
        self._domain = domains.hardware_clock if has_own_clock else domains.global_time
        self.device: Any = sdk.software_device()
        self.device.update_info(sdk.camera_info.name, NAME)
        self.device.register_info(sdk.camera_info.serial_number, SERIAL)
        self.device.register_info(sdk.camera_info.product_line, "L500")
        self._sensor: Any = self.device.add_sensor(SENSOR_NAME)
        self._sensor.add_read_only_option(sdk.option.depth_units, DEPTH_UNIT_M)
        for name, value in (celsius or {}).items():
            self._sensor.add_read_only_option(getattr(sdk.option, name), value)
        sizes = [intrinsics, intrinsics.scaled(intrinsics.width // 2, intrinsics.height // 2)]
        self._profiles: dict[tuple[str, tuple[int, ...]], Any] = {}
        for size in sizes if has_other_size else sizes[:1]:
            for stream in FORMATS:
                self._profiles[stream, (size.height, size.width)] = self._add(stream, size)
        self._register_extrinsics()

    def _add(self, stream: str, size: Intrinsics) -> Any:
        made = self._sdk.video_stream()
        made.type, made.index, made.uid = getattr(self._sdk.stream, stream), 0, len(self._profiles)
        made.width, made.height, made.fps = size.width, size.height, FRAMES_PER_S
        made.bpp, made.fmt = BYTES_PER_PIXEL[stream], getattr(self._sdk.format, FORMATS[stream])
        made.intrinsics = self._sdk_intrinsics(size)
        is_default = made.uid < len(FORMATS)
        return self._sdk.video_stream_profile(self._sensor.add_video_stream(made, is_default))

    def _sdk_intrinsics(self, mine: Intrinsics) -> Any:
        made = self._sdk.intrinsics()
        made.width, made.height = mine.width, mine.height
        made.fx, made.fy, made.ppx, made.ppy = mine.fx, mine.fy, mine.ppx, mine.ppy
        made.model, made.coeffs = self._sdk.distortion.none, [0.0] * 5
        return made

    def _register_extrinsics(self) -> None:
        """All streams are seen from one place; without saying so, playback fails."""
        same = self._sdk.extrinsics()
        same.rotation, same.translation = np.eye(3).ravel().tolist(), [0.0] * 3
        for one in self._profiles.values():
            for other in self._profiles.values():
                if one is not other:
                    one.register_extrinsics_to(other, same)

    def push(
        self, number: int, timestamp_s: float, images: SensedImages, streams: Collection[str] = tuple(FORMATS)
    ) -> None:
        """Deliver one instant on its streams, at the size of its images; only while the sensor streams."""
        pixels = {"depth": images.depth_z16, "infrared": images.ir, "confidence": images.confidence << 4}
        for (stream, shape), profile in self._profiles.items():
            if stream in streams and shape == images.ir.shape:
                self._push(profile, stream, number, timestamp_s, pixels[stream])

    def _push(self, profile: Any, stream: str, number: int, timestamp_s: float, pixels: NDArray[Any]) -> None:
        frame = self._sdk.software_video_frame()  # a new one each time: a pushed frame belongs to the SDK
        frame.pixels, frame.bpp = np.ascontiguousarray(pixels), BYTES_PER_PIXEL[stream]
        frame.stride = pixels.shape[1] * BYTES_PER_PIXEL[stream]
        frame.timestamp, frame.frame_number = timestamp_s * 1e3, number
        frame.domain, frame.profile = self._domain, profile  # of its size: the SDK reads as many pixels as that says
        self._sensor.on_video_frame(frame)
