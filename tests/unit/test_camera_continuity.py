from itertools import pairwise

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.camera.timestamps import Continuity
from nlos_cam.frames import Frame

NOTHING = np.zeros((1, 1), np.uint8)
PINHOLE = Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0)


def frame(number: int, timestamp_s: float) -> Frame:
    return Frame(NOTHING.astype(np.float32), NOTHING, NOTHING, timestamp_s, number, PINHOLE)


def passed_on(continuity: Continuity, numbers: range, zero_s: float, arrived_s: float) -> list[Frame]:
    """A device's run at 30 frames/s: number 0 is of `zero_s` by its clock, the first came at `arrived_s` by ours."""
    return [
        continuity.add(frame(number, zero_s + number / 30), arrived_s + (number - numbers[0]) / 30)
        for number in numbers
    ]


def test_a_first_run_is_passed_on_as_it_is() -> None:
    given = frame(7, 1.5)
    assert Continuity().add(given, arrived_s=99.0) is given


@pytest.mark.parametrize("zero_s", [1009.0, 0.0, 500_000.0], ids=["host's clock", "began anew", "jumped"])
def test_numbers_and_seconds_rise_together_over_an_outage(zero_s: float) -> None:
    """Ten seconds after the first, whatever the device's clock makes of it."""
    continuity = Continuity()
    before = passed_on(continuity, range(30), zero_s=1000.0, arrived_s=50.0)
    continuity.restart(counted=0)
    after = passed_on(continuity, range(30), zero_s, arrived_s=59.0)
    for one, next_one in pairwise(before + after):
        later = next_one.frame_number - one.frame_number
        assert later > 0
        assert (next_one.timestamp_s - one.timestamp_s) * 30 == pytest.approx(later, abs=0.01)
    assert after[0].timestamp_s - before[0].timestamp_s == pytest.approx(9.0)
    assert continuity.missed == after[0].frame_number - before[-1].frame_number - 1 == 240


def test_a_clock_that_agrees_with_the_host_is_believed_to_the_bit() -> None:
    continuity = Continuity()
    passed_on(continuity, range(3), zero_s=1000.0, arrived_s=50.0)
    continuity.restart(counted=0)
    assert continuity.add(frame(0, 1009.3), arrived_s=59.0).timestamp_s == 1009.3


def test_numbers_that_are_counted_already_are_not_missed_again() -> None:
    continuity = Continuity()
    passed_on(continuity, range(1), zero_s=0.0, arrived_s=0.0)
    continuity.restart(counted=20)
    continuity.restart(counted=5)
    passed_on(continuity, range(1), zero_s=1.0, arrived_s=1.0)
    assert continuity.missed == 29 - 25


def test_a_run_without_frames_leaves_no_trace() -> None:
    continuity = Continuity()
    continuity.restart(counted=0)
    assert continuity.add(frame(4, 2.0), arrived_s=0.0).frame_number == 4


def test_what_follows_at_once_still_rises() -> None:
    continuity = Continuity()
    passed_on(continuity, range(5), zero_s=10.0, arrived_s=0.0)
    continuity.restart(counted=0)
    next_one = continuity.add(frame(0, 0.0), arrived_s=4 / 30)
    assert next_one.frame_number == 5
    assert next_one.timestamp_s == pytest.approx(10 + 5 / 30)
