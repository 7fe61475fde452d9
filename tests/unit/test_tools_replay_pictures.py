from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.sensor.sensor import SensedImages


class FakeWorld:
    """A world of one value a frame."""

    rig, scene = load_rig("paper-rig"), SimpleNamespace(name="fake")

    def images(self, number: int) -> SensedImages:
        shape = 6, 8
        return SensedImages(
            np.full(shape, 400 + number, np.uint16), np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        )

    def truth_depth_m(self, number: int) -> np.ndarray:
        return np.full((64, 64), number, np.float32)

    def celsius(self, number: int) -> dict[str, float]:
        return {"ldd_temperature": 40.0 + number, "fan": 1.0}


def test_an_unhurried_camera_gives_each_frame_of_its_world_with_its_truth(tool: Callable[[str], ModuleType]) -> None:
    camera = tool("replay_pictures").Unhurried(FakeWorld(), 4)
    with camera as source:
        for number, frame in enumerate(source):
            assert frame.frame_number == number
            assert frame.timestamp_s == pytest.approx(number / 30)
            assert frame.depth_m == pytest.approx((400 + number) * 0.00025)
            assert (frame.truth_depth_m == number).all()
            assert camera.telemetry("_temperature") == {"ldd_temperature": 40.0 + number}
    assert number == 3
