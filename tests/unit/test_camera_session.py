from collections.abc import Callable
from threading import Timer
from time import monotonic
from types import SimpleNamespace
from typing import Any

import pytest
from fake_librealsense import FakeDevice, FakeSensor
from fake_lidar import FakeLidar

from nlos_cam.camera.session import SampleQueue, Session, find_streams, read_settings
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


def test_what_is_not_measured_yet_is_no_setting(fake_l515: Any) -> None:
    sensor = FakeSensor(fake_l515(apd_temperature=-9999.0, ldd_temperature=40.0), 0)
    settings = read_settings(sensor)
    assert settings["ldd_temperature"] == 40.0
    assert "apd_temperature" not in settings


def session_of(lidar: FakeLidar) -> Session:
    return Session(*find_streams(FakeDevice(lidar, 0)), SampleQueue(lossless=False))


def heard(session: Session) -> list[int]:
    """The numbers of the sets that were delivered."""
    numbers = list[int]()
    while found := session.inbox.take(0.0):
        numbers.append(found.number)
    return numbers


@pytest.fixture
def preparing(fake_l515: Any) -> Callable[[Callable[[Session, FakeLidar], Any]], Any]:
    """What an act gives that is done while a session prepares its sensor."""

    def prepare(act: Callable[[Session, FakeLidar], Any]) -> Any:
        lidar, given = fake_l515(usb="2.1"), list[Any]()
        session = session_of(lidar)
        session.start(lambda _: given.append(act(session, lidar)))
        session.stop()
        assert session.inbox.arrived.total() == 0  # what comes meanwhile is not delivered
        return given[0]

    return prepare


def test_while_a_sensor_is_prepared_the_next_set_can_be_looked_at(preparing: Any) -> None:
    def look(session: Session, lidar: FakeLidar) -> int:
        lidar.deliver(range(1, 4))
        later = Timer(0.1, lidar.deliver, [range(4, 5)])
        later.start()
        return session.look(5.0).number

    assert preparing(look) == 4


def test_a_look_ends_when_nothing_comes_or_nobody_waits_any_more(preparing: Any) -> None:
    def look(session: Session, _: FakeLidar) -> list[Any]:
        nothing, start_s = session.look(0.01), monotonic()
        Timer(0.1, session.end_wait).start()
        return [nothing, session.look(10.0), monotonic() - start_s < 5.0]

    assert preparing(look) == [None, None, True]


def test_a_device_that_vanishes_while_it_is_prepared_is_an_error(preparing: Any) -> None:
    with pytest.raises(RuntimeError, match="vanished"):
        preparing(lambda _, lidar: lidar.unplug())


def test_a_set_that_had_begun_before_the_settings_held_is_no_incomplete_one(fake_l515: Any) -> None:
    lidar = fake_l515(usb="2.1")
    session = session_of(lidar)
    session.start(lambda _: None, ready=lambda: lidar.deliver(range(5, 6), streams=("depth",)))
    lidar.deliver(range(5, 6), streams=("infrared", "confidence"))
    lidar.deliver(range(6, 8))
    assert heard(session) == [6, 7]
    assert session.inbox.incomplete == session.inbox.dropped == 0
    session.stop()


def test_a_clock_that_stands_still_holds_no_more_than_one_set_back(fake_l515: Any) -> None:
    lidar = fake_l515(usb="2.1")
    lidar.period_ms = 0.0
    session = session_of(lidar)
    session.start(lambda _: None)
    lidar.deliver(range(5, 8))
    assert heard(session) == [6, 7]
    session.stop()


def test_telemetry_of_a_session_that_stopped_is_empty(fake_l515: Any) -> None:
    session = session_of(fake_l515(usb="2.1"))
    assert session.telemetry()
    session.stop()
    assert session.telemetry() == {}
