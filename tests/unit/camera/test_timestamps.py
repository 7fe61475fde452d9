from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.geometry import Intrinsics

from nlos_cam.camera.timestamps import STEP_BACK, WRAP_PERIOD_S, ClockUnwrap, Continuity
from nlos_cam.frames import Frame

STEP_BACK_S = STEP_BACK * WRAP_PERIOD_S


def unwrapped(timestamps_s: list[float], period_s: float = WRAP_PERIOD_S) -> list[float]:
    clock = ClockUnwrap(period_s)
    return [clock.add(timestamp_s) for timestamp_s in timestamps_s]


@given(
    first_s=st.floats(0.0, WRAP_PERIOD_S),
    gaps_s=st.lists(st.floats(-STEP_BACK_S / 2, WRAP_PERIOD_S - 2 * STEP_BACK_S), max_size=20),
)
def test_unwrap_gives_the_times_of_a_clock_without_wraps(first_s: float, gaps_s: list[float]) -> None:
    true_s = [first_s]
    for gap_s in gaps_s:
        true_s.append(max(max(true_s) + gap_s, first_s))
    found_s = unwrapped([each_s % WRAP_PERIOD_S for each_s in true_s])
    offset_s = first_s - first_s % WRAP_PERIOD_S
    assert all(abs(found - true + offset_s) < 1e-6 for found, true in zip(found_s, true_s, strict=True))


@pytest.mark.parametrize(
    ("stamps_s", "period_s", "expected_s"),
    [
        ([0.1, 1 / 3, 5.0, 5.0, 1.7e9], WRAP_PERIOD_S, [0.1, 1 / 3, 5.0, 5.0, 1.7e9]),
        ([100.0, 99.9, 100.1, 41.0], WRAP_PERIOD_S, [100.0, 99.9, 100.1, 41.0]),
        ([WRAP_PERIOD_S - 0.001, 0.001] * 2, WRAP_PERIOD_S, [WRAP_PERIOD_S - 0.001, WRAP_PERIOD_S + 0.001] * 2),
        ([90.0, 20.0, 85.0, 10.0], 100.0, [90.0, 120.0, 185.0, 210.0]),
    ],
    ids=["rising", "small steps back", "streams beside a wrap", "two wraps"],
)
def test_unwrap_adds_a_period_at_each_wrap(stamps_s: list[float], period_s: float, expected_s: list[float]) -> None:
    assert unwrapped(stamps_s, period_s) == expected_s


def frame(number: int, timestamp_s: float) -> Frame:
    nothing = np.zeros((1, 1), np.uint8)
    pinhole = Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0)
    return Frame(nothing.astype(np.float32), nothing, nothing, timestamp_s, number, pinhole)


def passed_on(continuity: Continuity, numbers: range, zero_s: float, arrived_s: float) -> list[Frame]:
    """Add a run at 30 frames/s whose number 0 is of `zero_s` (device clock); its first came at `arrived_s` (ours)."""
    return [
        continuity.add(frame(number, zero_s + number / 30), arrived_s + (number - numbers[0]) / 30)
        for number in numbers
    ]


def test_continuity_passes_a_first_run_on_unchanged() -> None:
    given = frame(7, 1.5)
    assert Continuity().add(given, arrived_s=99.0) is given
    continuity = Continuity()
    continuity.restart(counted=0)  # after a run without frames
    assert continuity.add(frame(4, 2.0), arrived_s=0.0).frame_number == 4


@pytest.mark.parametrize("zero_s", [1009.0, 0.0, 500_000.0], ids=["host's clock", "restarted", "jumped"])
def test_numbers_and_seconds_rise_together_over_an_outage(zero_s: float) -> None:
    """The second run starts nine seconds after the first, whatever the device's clock says."""
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


def test_continuity_counts_missed_numbers_once() -> None:
    continuity = Continuity()
    passed_on(continuity, range(1), zero_s=0.0, arrived_s=0.0)
    continuity.restart(counted=20)
    continuity.restart(counted=5)
    passed_on(continuity, range(1), zero_s=1.0, arrived_s=1.0)
    assert continuity.missed == 29 - 25


@pytest.mark.parametrize(
    ("device_s", "arrived_s", "number", "timestamp_s"),
    [(0.0, 4 / 30, 5, 10 + 5 / 30), (19.3, 9.0, 279, 19.3)],
    ids=["the next run follows at once", "the device's clock agrees with the host's"],
)
def test_continuity_splices_the_next_run(device_s: float, arrived_s: float, number: int, timestamp_s: float) -> None:
    continuity = Continuity()
    passed_on(continuity, range(5), zero_s=10.0, arrived_s=0.0)
    continuity.restart(counted=0)
    found = continuity.add(frame(0, device_s), arrived_s)
    assert (found.frame_number, found.timestamp_s) == (number, pytest.approx(timestamp_s))
