"""The logic of the L515's backend, on a stand-in for the SDK; tests/hardware holds what only a device can show."""

import logging
from collections.abc import Callable
from typing import Any

import pytest
from fake_librealsense import FakeDevice
from fake_lidar import NapClock

from nlos_cam.camera.l515 import NEAR_WALL
from nlos_cam.camera.streams import FORMATS
from nlos_cam.errors import CameraError, CameraNotFoundError

Make = Callable[..., Any]


def test_no_device_says_what_to_check(fake_camera: Make) -> None:
    with pytest.raises(CameraNotFoundError, match=r"no L515 found .*sees no device.* check the USB 3 cable"):
        fake_camera()


def test_another_realsense_is_named_and_not_taken(fake_l515: Make, fake_camera: Make) -> None:
    d435 = fake_l515(serial="123", name="Intel RealSense D435")
    with pytest.raises(CameraNotFoundError, match="Intel RealSense D435 123"):
        fake_camera(d435)


def test_the_serial_number_chooses(fake_l515: Make, fake_camera: Make) -> None:
    one, other = fake_l515("f1"), fake_l515("f2")
    with fake_camera(one, other, serial="f2"):
        assert other.opened
    assert not one.opened


def test_one_of_several_has_to_be_named(fake_l515: Make, fake_camera: Make) -> None:
    with pytest.raises(CameraNotFoundError, match="l515:f1, l515:f2"):
        fake_camera(fake_l515("f1"), fake_l515("f2"))


def test_a_wrong_serial_is_not_found(fake_l515: Make, fake_camera: Make) -> None:
    with pytest.raises(CameraNotFoundError, match="no L515 with serial f9 found"):
        fake_camera(fake_l515("f1"), serial="f9")


@pytest.mark.parametrize(("usb", "size"), [("3.2", (640, 480)), ("2.1", (320, 240))])
def test_the_link_decides_the_resolution(
    usb: str, size: tuple[int, int], caplog: pytest.LogCaptureFixture, fake_l515: Make, fake_camera: Make
) -> None:
    device = fake_l515(usb=usb)
    with fake_camera(device) as camera:
        assert (camera.intrinsics.width, camera.intrinsics.height) == size
        assert [(profile.stream, profile.size) for profile in device.opened] == [(one, size) for one in FORMATS]
    assert ("USB 2.1" in caplog.text) == (usb == "2.1")


def test_near_wall_settings_follow_the_preset_which_follows_the_start(fake_l515: Make, fake_camera: Make) -> None:
    device, clock = fake_l515(), NapClock()
    with fake_camera(device, clock=clock):
        did = device.did
        assert did.index("start") < did.index("visual_preset") < min(did.index(name) for name in NEAR_WALL)
    assert clock.naps == [0.5]
    assert device.options["visual_preset"] == 5.0


def test_frames_carry_the_settings_as_read_back(
    caplog: pytest.LogCaptureFixture, fake_l515: Make, fake_camera: Make
) -> None:
    device = fake_l515()
    device.stubborn = {"min_distance"}
    with fake_camera(device) as camera:
        device.deliver(range(1, 2))
        frame = next(iter(camera))
    assert frame.settings == device.options
    assert frame.settings["min_distance"] == 9.0
    assert [record.message for record in caplog.records] == ["l515 reads back min_distance = 9.0 where 0 was set"]


def test_settings_that_take_are_not_spoken_of(
    caplog: pytest.LogCaptureFixture, fake_l515: Make, fake_camera: Make
) -> None:
    caplog.set_level(logging.WARNING)
    with fake_camera(fake_l515()):
        pass
    assert not caplog.records


def test_an_option_that_is_refused_is_told_and_the_rest_set(
    caplog: pytest.LogCaptureFixture, fake_l515: Make, fake_camera: Make
) -> None:
    device = fake_l515()
    device.refused = {"min_distance"}
    with fake_camera(device):
        assert device.options["invalidation_bypass"] == 0.0
    assert "does not take min_distance = 0: out of range" in caplog.text


def test_a_device_that_cannot_be_asked_is_told(
    monkeypatch: pytest.MonkeyPatch, fake_l515: Make, fake_camera: Make
) -> None:
    def fail(_device: FakeDevice, _key: str) -> bool:
        raise RuntimeError("no permission")

    monkeypatch.setattr(FakeDevice, "supports", fail)
    device = fake_l515()
    with pytest.raises(CameraError, match="no permission"):
        fake_camera(device)
