from threading import Timer
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeDevice, FakeSensor
from fake_lidar import FakeLidar

from nlos_cam.camera.session import QUEUED_SETS, SampleQueue, Session, find_streams, read_settings
from nlos_cam.camera.streams import FORMATS, Sample


def put(inbox: SampleQueue, numbers: range) -> None:
    for number in numbers:
        for stream in FORMATS:
            inbox.put(Sample(stream, number, number / 30, np.zeros((1, 1))))


def take_all(inbox: SampleQueue) -> list[int]:
    taken: list[int] = []
    while (found := inbox.take(0.0)) is not None:
        taken.append(found.number)
    return taken


def test_live_queue_drops_its_oldest_when_full() -> None:
    numbers: list[int] = []
    inbox = SampleQueue(on_set=lambda found: numbers.append(found.number))
    put(inbox, range(QUEUED_SETS + 3))

    assert take_all(inbox) == list(range(3, QUEUED_SETS + 3))
    assert inbox.dropped == 3
    assert numbers == list(range(QUEUED_SETS + 3))
    assert inbox.take(0.001) is None


def test_finish_of_a_live_device_counts_no_half_set() -> None:
    inbox = SampleQueue()
    inbox.put(Sample("depth", 0, 0.0, np.zeros((1, 1))))
    inbox.finish()

    assert inbox.incomplete == 0


@pytest.mark.parametrize("none", [-9999.0, float("nan"), float("inf")])
def test_read_settings_omits_unreadable_and_unmeasured_options(none: float) -> None:
    sensor = FakeSensor(FakeLidar(apd_temperature=none, ldd_temperature=40.0), 0)
    listed = [
        SimpleNamespace(name=name)
        for name in ("not_while_idle", "apd_temperature", "ldd_temperature")
    ]
    sensor.get_supported_options = lambda: listed

    assert read_settings(sensor) == {"ldd_temperature": 40.0}


def test_find_streams_takes_the_sensor_with_most_streams() -> None:
    partial = FakeSensor(FakeLidar(streams=("infrared",)), 0)
    whole = FakeSensor(FakeLidar(), 0)
    sensor, profiles = find_streams(SimpleNamespace(query_sensors=lambda: [partial, whole]))

    assert sensor is whole
    assert set(profiles) == set(FORMATS)
    assert find_streams(SimpleNamespace(query_sensors=list)) == (None, {})


def session_of(lidar: FakeLidar) -> Session:
    return Session(*find_streams(FakeDevice(lidar, 0)), SampleQueue())


def test_look_returns_the_next_set_while_preparing_or_none() -> None:
    lidar = FakeLidar(usb="2.1")
    found = list[Any]()
    session = session_of(lidar)

    def prepare(_: object) -> None:
        lidar.deliver(range(1, 4))
        Timer(0.1, lidar.deliver, [range(4, 5)]).start()
        found.append(session.look(30.0).number)
        found.append(session.look(0.01))
        Timer(0.1, session.end_wait).start()
        found.append(session.look(10_000.0))

    session.start(prepare, lambda: None)
    session.stop()

    assert found == [4, None, None]
    assert session.inbox.arrived.total() == 0  # none of these is delivered


@pytest.mark.parametrize("clock_stands", [False, True])
def test_set_from_before_the_settings_is_not_delivered(clock_stands: bool) -> None:
    """A clock that stands still holds no more than one set back."""
    lidar = FakeLidar(usb="2.1")
    session = session_of(lidar)
    early_streams = ("depth",)
    if clock_stands:
        lidar.period_ms = 0.0
        session.start(lambda _: None, lambda: None)
        lidar.deliver(range(5, 6))
    else:
        session.start(
            lambda _: None, ready=lambda: lidar.deliver(range(5, 6), streams=early_streams)
        )
        lidar.deliver(range(5, 6), streams=("infrared", "confidence"))
    lidar.deliver(range(6, 8))

    assert take_all(session.inbox) == [6, 7]
    assert clock_stands or session.inbox.incomplete == session.inbox.dropped == 0

    session.stop()
