"""Which devices of several are used, and what else than near-wall settings an L515 may have been left with."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from fake_librealsense import FakeSdk

from nlos_cam.camera.l515 import connected
from nlos_cam.errors import CameraError

Make = Callable[..., Any]


def test_a_device_that_cannot_be_asked_does_not_hide_another(fake_l515: Make) -> None:
    sdk = FakeSdk(fake_l515("f1"), fake_l515("f2"))
    one, other = sdk.context().query_devices()
    context = SimpleNamespace(query_devices=lambda: [broken(one), other])
    assert [info.serial for _, info in connected(sdk, context)] == ["f2"]
    with pytest.raises(CameraError, match="no such luck"):
        connected(sdk, SimpleNamespace(query_devices=lambda: [broken(one)]))


def broken(device: Any) -> Any:
    def fail(_: str) -> bool:
        raise RuntimeError("no such luck")

    device.supports = fail
    return device


def test_modes_that_make_something_else_of_infrared_are_turned_off_where_they_are_on(
    fake_l515: Make, fake_camera: Make
) -> None:
    lidar = fake_l515()
    lidar.options |= {"alternate_ir": 1.0, "enable_max_usable_range": 0.0}
    with fake_camera(lidar):
        assert lidar.options["alternate_ir"] == 0.0
        assert "alternate_ir" in lidar.did
        assert not {"enable_max_usable_range", "enable_ir_reflectivity"} & set(lidar.did)
