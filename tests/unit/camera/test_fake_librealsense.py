import inspect
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeContext, FakeDevice, FakeRecorder, FakeSdk, FakeSensor
from fake_lidar import FakeFrame, FakeLidar, FakeProfile, NapClock

from nlos_cam.camera import FORMATS, SoftwareLidar, find_streams, load_sdk
from nlos_cam.camera.l515 import L515Camera


@pytest.mark.parametrize(
    ("fake", "real"),
    [
        (FakeContext, "context"),
        (FakeDevice, "device"),
        (FakeRecorder, "recorder"),
        (FakeSensor, "sensor"),
        (FakeProfile, "video_stream_profile"),
        (FakeFrame, "video_frame"),
    ],
)
def test_every_method_of_a_fake_is_one_of_the_sdk(fake: type, real: str) -> None:
    methods = {
        name for name, _ in inspect.getmembers(fake, inspect.isfunction) if not name.startswith("_")
    }
    assert methods <= set(dir(getattr(load_sdk(), real)))


def test_every_name_that_a_camera_uses_is_one_of_the_sdk() -> None:
    sdk = FakeSdk(FakeLidar(usb="2.1", runs=(10**6,), laser_power=93.0))
    real = load_sdk()
    with L515Camera("l515", "", sdk=sdk, clock=NapClock()) as camera:
        next(iter(camera))

    assert {"laser_power", "visual_preset", "min_distance"} <= sdk.option.asked
    assert all(hasattr(real.option, name) for name in sdk.option.asked)
    assert all(hasattr(real.camera_info, name) for name in sdk.camera_info.asked)
    assert hasattr(real.timestamp_domain, FakeFrame.domain)
    assert all(
        hasattr(real.stream, stream) and hasattr(real.format, form)
        for stream, form in FORMATS.items()
    )


def test_options_of_fake_and_sdk_look_and_fail_alike(noise_world: Any) -> None:
    sensor, _ = find_streams(SoftwareLidar(noise_world().rig.pinhole, load_sdk()).device)
    fake = FakeSensor(FakeLidar(), 0)
    for tested, sdk in ((sensor, load_sdk()), (fake, FakeSdk())):
        assert "depth_units" in {option.name for option in tested.get_supported_options()}
        assert not tested.supports(sdk.option.laser_power)
        for ask in (tested.get_option, tested.get_option_range):
            with pytest.raises(RuntimeError):
                ask(sdk.option.laser_power)
    limits = fake.get_option_range(FakeSdk().option.depth_units)

    assert vars(limits).keys() <= set(dir(sensor.get_option_range(load_sdk().option.depth_units)))


def test_handle_fails_once_its_lidar_was_unplugged() -> None:
    lidar = FakeLidar(laser_power=93.0)
    option = FakeSdk().option
    device = FakeDevice(lidar, lidar.generation)
    [sensor] = device.query_sensors()
    sensor.set_option(option.laser_power, 12.0)
    lidar.unplug()

    assert lidar.options["laser_power"] == 93.0

    lidar.plug_in()
    calls = (lambda: sensor.get_option(option.depth_units), lambda: sensor.open([]))
    for call in (*calls, device.query_sensors, device.hardware_reset):
        with pytest.raises(RuntimeError):
            call()
    [sensor] = FakeContext([lidar]).query_devices()[0].query_sensors()

    assert sensor.get_option(option.depth_units) > 0


def test_color_camera_is_described_as_the_sdk_does() -> None:
    sdk = load_sdk()
    lidar = FakeLidar(runs=(3,))

    assert len(FakeDevice(lidar, 0).query_sensors()) == 1

    lidar.colour = lambda number: 50 * number
    depth, color = FakeDevice(lidar, 0).query_sensors()
    profile = color.get_stream_profiles()[1]

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


ORDERS = [
    [],
    ["open"],
    ["open", "start"],
    ["open", "start", "stop"],
    ["open", "start", "stop", "close"],
]
"""Calls of a sensor in turn."""


def refused(sensor: Any, profiles: list[Any], name: str) -> bool:
    """Return True where the sensor refuses a call."""
    arguments = {"open": [profiles], "start": [lambda _: None]}.get(name, [])
    try:
        getattr(sensor, name)(*arguments)
    except RuntimeError:
        return True
    return False


@pytest.mark.parametrize("order", ORDERS, ids=" ".join)
@pytest.mark.parametrize("then", ["open", "start", "stop", "close"])
def test_fake_refuses_calls_out_of_turn_as_the_sdk_does(
    noise_world: Any, order: list[str], then: str
) -> None:
    device = SoftwareLidar(noise_world().rig.pinhole, load_sdk()).device
    real, streams = find_streams(device)
    fake = FakeSensor(FakeLidar(runs=(0,)), 0)
    profiles = {real: list(streams.values()), fake: fake.get_stream_profiles()[:3]}
    found = [
        [refused(sensor, profiles[sensor], name) for name in (*order, then)]
        for sensor in (real, fake)
    ]
    for sensor in (real, fake):
        for name in ("stop", "close"):
            refused(sensor, [], name)

    assert found[0] == found[1]
    assert not any(found[0][:-1])
