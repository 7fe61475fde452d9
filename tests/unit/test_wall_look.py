from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import Intrinsics

from nlos_cam.calibrate.measure import CELSIUS_EVERY, look
from nlos_cam.frames import Frame, maps_from_frame

INTRINSICS = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)
SHAPE = (64, 80)


class Warming:
    """A camera whose thermometer rises by a degree with each look at it; the wall is one depth, with noise."""

    uri, intrinsics = "l515", INTRINSICS

    def __init__(self, frames: int) -> None:
        self.identity = {"serial": "f1"}
        self.celsius = 30.0
        generator = np.random.default_rng(0)
        depths_m = 0.2 + 0.001 * generator.standard_normal((frames, *SHAPE))
        counts = np.full(SHAPE, 48, np.uint8)
        self.given = [
            Frame(depth_m.astype(np.float32), counts, counts, number / 30, number, INTRINSICS, {"laser_power": 40.0})
            for number, depth_m in enumerate(depths_m)
        ]

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.given)

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        assert ending == "_temperature"
        self.celsius += 1.0
        return {"ldd_temperature": self.celsius}


def looked(camera: Any, frames: int = 1000) -> Any:
    return look(camera, frames)


def test_statistics_are_of_all_frames_and_their_maps() -> None:
    camera = Warming(20)
    wall = looked(camera).reference(np.ones(SHAPE, np.bool_))
    depths_m = np.stack([frame.depth_m for frame in camera.given]).astype(np.float64)
    maps_m = np.stack([maps_from_frame(frame).depth_m for frame in camera.given])
    np.testing.assert_allclose(wall.depth_m, depths_m.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(wall.map_depth_m, maps_m.mean(axis=0), rtol=1e-6)
    np.testing.assert_array_equal(wall.map_intensity, 48.0)
    assert (wall.frames, wall.serial, wall.settings) == (20, "f1", {"laser_power": 40.0})


def test_thermometers_are_looked_at_now_and_then() -> None:
    seen = looked(Warming(2 * CELSIUS_EVERY + 1))
    assert seen.facts()["temperatures_c"] == {"ldd_temperature": 32.0}
    assert seen.reference(np.ones(SHAPE, np.bool_)).celsius_span == {"ldd_temperature": 2.0}


def test_no_more_frames_are_taken_than_asked_for() -> None:
    assert looked(Warming(10), 4).statistics.depth.frames == 4


def test_no_frames_are_refused() -> None:
    with pytest.raises(WallRefusedError, match="l515 gave no frames"):
        looked(Warming(0))
