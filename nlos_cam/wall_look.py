"""What a camera saw of a bench that stood still: the statistics of its frames, and what it was seen with."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
from nlos_calibration.bare_wall import BareWall, BareWallStatistics
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.projection import Intrinsics
from numpy.typing import NDArray

from nlos_cam.camera.protocol import Camera
from nlos_cam.frames import maps_from_frame

CELSIUS_EVERY = 30
"""Frames between two looks at the thermometers: each costs a device a command."""


@dataclass(frozen=True)
class Seen:
    """What was looked at, and by what."""

    camera: str
    """The URI."""
    statistics: BareWallStatistics
    intrinsics: Intrinsics
    serial: str
    firmware: str
    settings: Mapping[str, float]

    def reference(self, inliers: NDArray[np.bool_]) -> BareWall:
        """The bench as difference maps are formed from it; `inliers` (height, width) are the pixels of the plane."""
        return self.statistics.reference(inliers, serial=self.serial, settings=self.settings)

    def facts(self) -> dict[str, object]:
        """What a record says of the device."""
        told = {"serial": self.serial, "firmware": self.firmware}
        return {**told, "settings": dict(self.settings), "temperatures_c": self.statistics.celsius()}


def look(camera: Camera, frames: int, on_frame: Callable[[], None] = lambda: None) -> Seen:
    """The statistics over at most `frames` frames of an entered camera. Raises WallRefusedError where none comes."""
    statistics, settings = BareWallStatistics(camera.intrinsics), dict[str, float]()
    for number, frame in enumerate(islice(camera, frames)):
        maps = maps_from_frame(frame)
        statistics.add(frame.depth_m, frame.ir, maps.depth_m, maps.intensity)
        settings = dict(frame.settings)
        if number % CELSIUS_EVERY == 0:
            statistics.look_at(camera.telemetry("_temperature"))
        on_frame()
    if statistics.depth.frames == 0:
        raise WallRefusedError(f"{camera.uri} gave no frames: record the wall again, or look at it live")
    serial, firmware = (camera.identity.get(name, "") for name in ("serial", "firmware"))
    return Seen(camera.uri, statistics, camera.intrinsics, serial, firmware, settings)
