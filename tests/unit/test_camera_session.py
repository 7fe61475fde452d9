from types import SimpleNamespace
from typing import Any

import pytest
from fake_librealsense import FakeDevice, FakeSensor

from nlos_cam.camera.session import find_streams, read_settings
from nlos_cam.camera.streams import FORMATS


class Shy:
    """A sensor that lists an option which it does not let be read."""

    def get_supported_options(self) -> list[Any]:
        return [SimpleNamespace(name=name) for name in ("min_distance", "apd_temperature", "depth_units")]

    def get_option(self, option: Any) -> float:
        if option.name == "apd_temperature":
            raise RuntimeError("not while idle")
        return 1.0


def test_settings_are_all_that_can_be_read() -> None:
    assert read_settings(Shy()) == {"min_distance": 1.0, "depth_units": 1.0}


def test_the_sensor_with_most_of_our_streams_is_found(fake_l515: Any) -> None:
    partial, whole = FakeSensor(fake_l515(streams=("infrared",)), 0), FakeSensor(fake_l515(), 0)
    device = SimpleNamespace(query_sensors=lambda: [partial, whole])
    sensor, profiles = find_streams(device)
    assert sensor is whole
    assert set(profiles) == set(FORMATS)


@pytest.mark.parametrize("size", [(1024, 768), (640, 480), (320, 240)])
def test_profiles_are_those_of_the_size_asked_for(fake_l515: Any, size: tuple[int, int]) -> None:
    _, profiles = find_streams(FakeDevice(fake_l515(), 0), size)
    assert {profile.size for profile in profiles.values()} == {size}


def test_a_size_that_is_not_offered_finds_no_streams(fake_l515: Any) -> None:
    assert find_streams(FakeDevice(fake_l515(), 0), (100, 100))[1] == {}


def test_a_device_without_sensors_has_no_streams() -> None:
    assert find_streams(SimpleNamespace(query_sensors=list)) == (None, {})
