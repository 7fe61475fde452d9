"""Holds the fake against librealsense itself: what the camera layer uses is there, and fails as the fake does."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeContext, FakeDevice, FakeRecorder, FakeSdk, FakeSensor
from fake_lidar import FakeFrame, FakeLidar, FakeProfile, NapClock

from nlos_cam.camera.l515 import L515Camera
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import find_streams
from nlos_cam.camera.simulated import SoftwareLidar
from nlos_cam.camera.streams import FORMATS

Make = Callable[..., Any]


def methods(cls: type) -> set[str]:
    """The public ones, which the camera layer may use."""
    return {name for name, _ in inspect.getmembers(cls, inspect.isfunction) if not name.startswith("_")}


@pytest.mark.parametrize(
    ("fake", "real"),
    [
        (FakeContext, ["context"]),
        (FakeDevice, ["device"]),
        (FakeRecorder, ["recorder"]),
        (FakeSensor, ["sensor"]),
        (FakeProfile, ["video_stream_profile"]),
        (FakeFrame, ["video_frame"]),
    ],
)
def test_every_method_of_the_fake_is_one_of_the_sdk(fake: type, real: list[str]) -> None:
    sdk = load_sdk()
    assert methods(fake) <= set().union(*(dir(getattr(sdk, name)) for name in real))


def test_every_name_that_a_camera_asks_for_is_one_of_the_sdk() -> None:
    sdk, real = FakeSdk(FakeLidar(usb="2.1", runs=(10**6,), laser_power=93.0)), load_sdk()
    with L515Camera("l515", "", sdk=sdk, clock=NapClock()) as camera:
        next(iter(camera))
    assert {"laser_power", "visual_preset", "min_distance"} <= sdk.option.asked
    assert all(hasattr(real.option, name) for name in sdk.option.asked)
    assert all(hasattr(real.camera_info, name) for name in sdk.camera_info.asked)
    assert hasattr(real.timestamp_domain, FakeFrame.domain)
    assert all(hasattr(real.stream, stream) and hasattr(real.format, form) for stream, form in FORMATS.items())


@pytest.fixture
def real_sensor(noise_world: Make) -> Any:
    sensor, _ = find_streams(SoftwareLidar(noise_world().rig.pinhole, load_sdk()).device)
    return sensor


def test_an_option_that_is_not_there_fails_alike(real_sensor: Any) -> None:
    option, fake = load_sdk().option.laser_power, FakeSensor(FakeLidar(), 0)
    named = FakeSdk().option.laser_power
    for sensor, name in ((real_sensor, option), (fake, named)):
        assert not sensor.supports(name)
        for ask in (sensor.get_option, sensor.get_option_range):
            with pytest.raises(RuntimeError):
                ask(name)


def test_a_range_has_the_same_fields(real_sensor: Any) -> None:
    found = real_sensor.get_option_range(load_sdk().option.depth_units)
    fake = FakeSensor(FakeLidar(), 0).get_option_range(FakeSdk().option.depth_units)
    assert vars(fake).keys() <= {name for name in dir(found) if not name.startswith("_")}


def test_options_are_listed_by_members_with_a_name(real_sensor: Any) -> None:
    assert "depth_units" in {option.name for option in real_sensor.get_supported_options()}
    assert "depth_units" in {option.name for option in FakeSensor(FakeLidar(), 0).get_supported_options()}


def test_a_handle_fails_once_its_lidar_was_unplugged_also_when_it_is_back() -> None:
    lidar = FakeLidar()
    device = FakeDevice(lidar, lidar.generation)
    [sensor] = device.query_sensors()
    lidar.unplug()
    lidar.plug_in()
    option = FakeSdk().option.depth_units
    for act in (
        lambda: sensor.get_option(option),
        lambda: sensor.open([]),
        device.query_sensors,
        device.hardware_reset,
    ):
        with pytest.raises(RuntimeError):
            act()
    assert FakeContext([lidar]).query_devices()[0].query_sensors()[0].get_option(option) > 0


def test_unplugging_loses_the_settings() -> None:
    lidar = FakeLidar(laser_power=93.0)
    FakeSensor(lidar, 0).set_option(FakeSdk().option.laser_power, 12.0)
    lidar.unplug()
    assert lidar.options["laser_power"] == 93.0


def test_a_run_gives_its_frames_from_number_0_and_then_none() -> None:
    lidar, got = FakeLidar(runs=(4, 2)), list[FakeFrame]()
    [sensor] = FakeContext([lidar]).query_devices()[0].query_sensors()
    for count in (4, 2):
        got.clear()
        sensor.open(sensor.get_stream_profiles()[:3])
        sensor.start(got.append)
        assert lidar.finish_run()
        sensor.stop()
        assert [frame.get_frame_number() for frame in got] == [n for n in range(count) for _ in FORMATS]


def test_infrared_saturates_by_the_laser_power() -> None:
    lidar, got = FakeLidar(laser_power=50.0), list[FakeFrame]()
    lidar.saturated_share = lambda power: power / 100
    [sensor] = FakeContext([lidar]).query_devices()[0].query_sensors()
    sensor.open([profile for profile in sensor.get_stream_profiles() if profile.stream == "infrared"][:1])
    sensor.start(got.append)
    assert np.mean(got[0].get_data() == 255) == pytest.approx(0.5)


def test_its_colour_camera_is_told_as_the_sdks_are() -> None:
    sdk, lidar = load_sdk(), FakeLidar()
    assert len(FakeDevice(lidar, 0).query_sensors()) == 1
    lidar.colour = lambda number: number
    depth, colour = FakeDevice(lidar, 0).query_sensors()
    profile = colour.get_stream_profiles()[1]
    assert hasattr(sdk.stream, profile.stream_type().name)
    assert hasattr(sdk.format, profile.format().name)
    made = profile.get_intrinsics()
    assert vars(made).keys() <= set(dir(sdk.intrinsics()))
    assert made.model.name in sdk.distortion.__members__
    extrinsics = profile.get_extrinsics_to(depth.get_stream_profiles()[0])
    assert vars(extrinsics).keys() <= set(dir(sdk.extrinsics()))
    turn = np.reshape(extrinsics.rotation, (3, 3)).T
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_its_colour_camera_gives_what_it_sees() -> None:
    lidar, got = FakeLidar(runs=(3,)), list[FakeFrame]()
    lidar.colour = lambda number: 50 * number
    _, colour = FakeDevice(lidar, 0).query_sensors()
    colour.open(colour.get_stream_profiles()[-1:])
    colour.start(got.append)
    assert lidar.finish_run()
    colour.stop()
    assert [(frame.get_data().shape, int(frame.get_data().mean())) for frame in got] == [
        ((480, 640, 3), 50 * number) for number in range(3)
    ]
