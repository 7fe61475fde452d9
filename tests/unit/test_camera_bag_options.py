import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.recording.bag_container import BagContainer
from nlos_cam.recording.bag_reader import RecordedOptions

TOPIC = "/device_0/sensor_0/option/Frames_Queue_Size/value"
CHANGES = {10_000_000: 3.0, 20_000_000: 5.0, 30_000_000: 4.0}


@pytest.fixture
def changing(rewritten: Any) -> Path:
    """A recording one of whose options changes three times."""

    def edit(topic: str, time_ns: int, raw: bytes) -> Iterable[tuple[int, bytes]]:
        yield time_ns, raw
        if topic == TOPIC:
            for later_ns, value in CHANGES.items():
                yield later_ns, struct.pack("<f", value)

    return rewritten(edit)


def options(path: Path) -> RecordedOptions:
    unit = "/device_0/sensor_0/option/Depth_Units/value"
    return RecordedOptions(BagContainer(path), {TOPIC: "Frames_Queue_Size", unit: "Depth_Units"})


def test_the_value_in_force_is_the_last_that_was_told(changing: Path) -> None:
    found = options(changing)
    for time_ns, value in {1: 0.0, 9_999_999: 0.0, **CHANGES, 10**12: 4.0}.items():
        assert found.at(time_ns)["frames_queue_size"] == value
        assert found.at(time_ns)["depth_units"] == pytest.approx(0.00025)


def test_the_order_of_asking_does_not_matter(changing: Path) -> None:
    times_ns = [10**12, 1, 25_000_000, 15_000_000, 35_000_000, 0]
    found = options(changing)
    assert [found.at(each) for each in times_ns] == [options(changing).at(each) for each in times_ns]


def test_the_same_object_is_given_until_one_changes(changing: Path) -> None:
    found = options(changing)
    before = found.at(11_000_000)
    assert found.at(12_000_000) is before
    after = found.at(21_000_000)
    assert after is not before
    assert before["frames_queue_size"] == 3.0


def test_nothing_is_in_force_before_the_first_was_told(changing: Path) -> None:
    assert options(changing).at(0) == {}
