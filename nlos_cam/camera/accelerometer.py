"""Accelerometer of a device: gravity in the lidar frame, which shows which way up the camera is."""

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from threading import Lock
from typing import Any, Self

import numpy as np
from nlos_calibration import Gravity, is_gravity
from nlos_calibration.arrays import Float64

from nlos_cam.camera.streams import stream_name

FORMAT = "motion_xyz32f"
MIN_SHARE = 0.25
"""Share of a second's samples from which on their mean counts."""

Acceleration = tuple[float, float, float]
"""m/s^2 in the accelerometer's frame. At rest it points up: what holds the device accelerates it
against its fall.
"""


def gravity_of(samples: Sequence[Acceleration], lidar_from_sensor: Float64) -> Gravity | None:
    """Return gravity in the lidar frame by the mean of accelerations, with the rotation (3, 3) into
    that frame; None without any, and while the device is moved.
    """
    if not samples:
        return None
    x, y, z = (-(lidar_from_sensor @ np.mean(samples, axis=0))).tolist()
    return (x, y, z) if is_gravity((x, y, z)) else None


class Accelerometer:
    """Accelerometer of a device and the samples of its last second, between `start` and `stop`.

    A device that does not let it start gives no gravity, and no error: no picture depends on it.
    Samples come on the SDK's thread; any thread may ask for `gravity`.
    """

    def __init__(self, sensor: Any, profile: Any, depth: Any) -> None:
        self._sensor: Any = sensor
        self._profile: Any = profile
        self._lidar_from_sensor = _rotation(profile, depth)
        self._samples = deque[Acceleration](maxlen=profile.fps())
        self._lock = Lock()

    @classmethod
    def of(cls, device: Any, depth: Any) -> Self | None:
        """Return the accelerometer of a device, at its lowest rate; None without one. `depth` is
        the profile of the depth stream.
        """
        offered = [
            (sensor, profile)
            for sensor in device.query_sensors()
            for profile in sensor.get_stream_profiles()
            if stream_name(profile) == "accel" and profile.format().name == FORMAT
        ]
        if not offered:
            return None
        sensor, profile = min(offered, key=lambda pair: pair[1].fps())
        return cls(sensor, profile, depth)

    def start(self) -> None:
        """Start the samples."""
        with suppress(RuntimeError):
            self._sensor.open(self._profile)
            self._sensor.start(self._on_frame)

    def stop(self) -> None:
        """Stop the samples, and release the sensor."""
        for end in (self._sensor.stop, self._sensor.close):
            with suppress(RuntimeError):  # it vanished, or never started
                end()
        self._sensor = None
        self._profile = None

    def _on_frame(self, frame: Any) -> None:
        found = frame.as_motion_frame().get_motion_data()
        with self._lock:
            self._samples.append((found.x, found.y, found.z))

    def gravity(self) -> Gravity | None:
        """Return gravity by the last second; None before a quarter of it, and while the device is
        moved.
        """
        with self._lock:
            samples = list(self._samples)
        if len(samples) < MIN_SHARE * (self._samples.maxlen or 0):
            return None
        return gravity_of(samples, self._lidar_from_sensor)


def _rotation(profile: Any, depth: Any) -> Float64:
    """Return the rotation (3, 3) from the accelerometer's frame to the lidar's; none where the SDK
    knows none, since it aligns the axes of both.
    """
    try:
        columns = profile.get_extrinsics_to(depth).rotation
    except RuntimeError:
        return np.eye(3)
    return np.reshape(columns, (3, 3)).T
