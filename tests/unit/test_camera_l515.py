"""The logic of the L515's backend, on a stand-in for the SDK; tests/hardware holds what only a device can show."""

import logging
from collections.abc import Callable
from itertools import islice
from threading import Event
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeDevice
from fake_lidar import NapClock

from nlos_cam.camera.l515 import NEAR_WALL, L515Camera
from nlos_cam.camera.streams import FORMATS
from nlos_cam.errors import CameraError, CameraNotFoundError

Make = Callable[..., Any]
TOLD = "l515: min_distance: 0 was wanted, 9 is read back"
ENDLESS = (10**6,)


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
    assert clock.naps == [0.5, 0.5]
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
    assert [record.message for record in caplog.records] == [TOLD]


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
    assert "min_distance: 0 was refused (out of range)" in caplog.text


def test_a_device_that_cannot_be_asked_is_told(
    monkeypatch: pytest.MonkeyPatch, fake_l515: Make, fake_camera: Make
) -> None:
    def fail(_device: FakeDevice, _key: str) -> bool:
        raise RuntimeError("no permission")

    monkeypatch.setattr(FakeDevice, "supports", fail)
    device = fake_l515()
    with pytest.raises(CameraError, match="no permission"):
        fake_camera(device)


def test_differences_are_kept_and_told_once(
    caplog: pytest.LogCaptureFixture, fake_l515: Make, fake_camera: Make
) -> None:
    lidar = fake_l515()
    lidar.stubborn = {"min_distance"}
    del lidar.options["invalidation_bypass"]
    camera = fake_camera(lidar)
    for _ in range(2):
        with camera:
            assert camera.differences == {
                "min_distance": "0 was wanted, 9 is read back",
                "invalidation_bypass": "not offered by this firmware",
            }
    assert caplog.text.count("min_distance") == caplog.text.count("invalidation_bypass") == 1


def test_what_does_not_take_at_first_is_set_once_more(fake_l515: Make, fake_camera: Make) -> None:
    """The preset may still be changing."""

    class Slow(NapClock):
        def wait(self, stop: Event, seconds: float) -> bool:
            if len(self.naps) == 1:
                lidar.stubborn.clear()
            return super().wait(stop, seconds)

    lidar, clock = fake_l515(), Slow()
    lidar.stubborn = {"min_distance"}
    with fake_camera(lidar, clock=clock) as camera:
        assert camera.differences == {}
    assert clock.naps == [0.5, 0.5]
    assert lidar.did.count("min_distance") == 2
    assert lidar.did.count("noise_filtering") == 1


@pytest.mark.parametrize(("name", "nap", "wanted"), [("visual_preset", 0, 5.0), ("min_distance", 1, 0.0)])
def test_what_the_starting_device_sets_back_is_set_once_more(
    fake_l515: Make, fake_camera: Make, name: str, nap: int, wanted: float
) -> None:
    class Starting(NapClock):
        def wait(self, stop: Event, seconds: float) -> bool:
            if len(self.naps) == nap:
                lidar.options[name] = lidar.factory[name]
            return super().wait(stop, seconds)

    lidar = fake_l515()
    with fake_camera(lidar, clock=Starting()) as camera:
        assert camera.differences == {}
    assert lidar.options[name] == wanted


@pytest.mark.parametrize(("threshold", "found"), [(100.0, 93.0), (60.0, 53.0), (53.0, 53.0), (20.0, 13.0)])
def test_the_laser_is_turned_down_until_little_saturates(
    fake_l515: Make, fake_camera: Make, caplog: pytest.LogCaptureFixture, threshold: float, found: float
) -> None:
    lidar = fake_l515(usb="2.1", runs=ENDLESS, laser_power=93.0)
    lidar.saturated_share = lambda power: 0.3 if power > threshold else 0.0005
    with fake_camera(lidar) as camera:
        frame = next(iter(camera))
    assert frame.settings["laser_power"] == found
    assert np.count_nonzero(frame.ir == 255) <= 0.001 * frame.ir.size  # none from before it was found
    assert ("turned down to" in caplog.text) == (found < 93.0)


def test_what_saturates_with_the_weakest_laser_is_told_with_advice(
    fake_l515: Make, fake_camera: Make, caplog: pytest.LogCaptureFixture
) -> None:
    lidar = fake_l515(usb="2.1", runs=ENDLESS, laser_power=93.0)
    lidar.saturated_share = lambda _: 0.02
    with fake_camera(lidar) as camera:
        assert next(iter(camera)).settings["laser_power"] == 1.0
    assert "2.0 % of the infrared image is saturated at laser power 1: go farther from the wall, or tilt" in caplog.text


def test_a_device_that_comes_back_has_the_laser_power_that_was_found(fake_l515: Make, fake_camera: Make) -> None:
    lidar = fake_l515(usb="2.1", runs=(100, 10**6), laser_power=93.0)
    lidar.saturated_share = lambda power: 0.3 if power > 60.0 else 0.0
    lidar.flaps = 1
    with fake_camera(lidar) as camera:
        camera.silence_s = 0.3
        frames = iter(camera)
        while not camera.counts["replugged"]:
            found = next(frames)
        assert found.settings["laser_power"] == 53.0
    since = lidar.did[lidar.did.index("unplugged") :]
    assert since.count("laser_power") == 1


def test_two_cameras_share_one_context_and_mind_their_own_device(fake_l515: Make, fake_sdk: Make) -> None:
    one, other = fake_l515("f1", usb="2.1", runs=ENDLESS), fake_l515("f2", usb="2.1", runs=ENDLESS)
    sdk = fake_sdk(one, other)
    made = [L515Camera(f"l515:{serial}", serial, sdk=sdk, clock=NapClock()) for serial in ("f1", "f2")]
    with made[0] as first, made[1] as second:
        assert first.identity["serial"] == "f1"
        assert second.identity["serial"] == "f2"
        for camera in (first, second):
            assert len(list(islice(camera, 5))) == 5
    assert sdk.contexts == 1


def test_identity_is_what_the_device_tells(fake_l515: Make, fake_camera: Make) -> None:
    lidar = fake_l515()
    del lidar.info["usb_type_descriptor"]
    expected = {"name": "Intel RealSense L515", "serial": "f0246262", "firmware": "01.05.08.01"}
    assert fake_camera(lidar).identity == expected


def test_telemetry_leaves_out_what_is_not_measured_yet(fake_l515: Make, fake_camera: Make) -> None:
    lidar = fake_l515(apd_temperature=-9999.0, ldd_temperature=41.5)
    camera = fake_camera(lidar)
    assert camera.telemetry() == {}
    with camera:
        assert camera.telemetry()["ldd_temperature"] == 41.5
        assert "apd_temperature" not in camera.telemetry()
        lidar.options["apd_temperature"] = 38.0
        assert camera.telemetry()["apd_temperature"] == 38.0
        assert set(camera.telemetry("_temperature")) == {"ldd_temperature", "apd_temperature"}
        lidar.unplug()
        assert camera.telemetry() == {}
    assert camera.telemetry() == {}


def test_a_device_that_vanishes_while_it_is_set_up_is_told(fake_l515: Make, fake_camera: Make) -> None:
    class Pulled(NapClock):
        def wait(self, stop: Event, seconds: float) -> bool:
            lidar.unplug()
            return super().wait(stop, seconds)

    lidar = fake_l515()
    with pytest.raises(CameraError, match=r"does not start .*vanished"):
        fake_camera(lidar, clock=Pulled()).__enter__()
