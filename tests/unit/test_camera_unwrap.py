from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera.timestamps import STEP_BACK, WRAP_PERIOD_S, ClockUnwrap

STEP_BACK_S = STEP_BACK * WRAP_PERIOD_S


def unwrapped(timestamps_s: list[float], period_s: float = WRAP_PERIOD_S) -> list[float]:
    clock = ClockUnwrap(period_s)
    return [clock.add(timestamp_s) for timestamp_s in timestamps_s]


@given(
    first_s=st.floats(0.0, WRAP_PERIOD_S),
    gaps_s=st.lists(st.floats(-STEP_BACK_S / 2, WRAP_PERIOD_S - 2 * STEP_BACK_S), max_size=20),
)
def test_a_clock_that_wraps_is_told_as_one_that_does_not(first_s: float, gaps_s: list[float]) -> None:
    true_s = [first_s]
    for gap_s in gaps_s:
        true_s.append(max(max(true_s) + gap_s, first_s))
    found_s = unwrapped([each_s % WRAP_PERIOD_S for each_s in true_s])
    offset_s = first_s - first_s % WRAP_PERIOD_S
    assert all(abs(found - true + offset_s) < 1e-6 for found, true in zip(found_s, true_s, strict=True))


def test_timestamps_that_rise_are_left_as_they_are() -> None:
    rising_s = [0.1, 1 / 3, 5.0, 5.0, 1.7e9]
    assert unwrapped(rising_s) == rising_s


def test_a_small_step_back_is_no_wrap() -> None:
    assert unwrapped([100.0, 99.9, 100.1, 41.0]) == [100.0, 99.9, 100.1, 41.0]


def test_streams_that_straddle_a_wrap_stay_together() -> None:
    before_s, after_s = WRAP_PERIOD_S - 0.001, 0.001
    assert unwrapped([before_s, after_s, before_s, after_s]) == [before_s, WRAP_PERIOD_S + 0.001] * 2


def test_each_wrap_adds_a_period() -> None:
    assert unwrapped([90.0, 20.0, 85.0, 10.0], period_s=100.0) == [90.0, 120.0, 185.0, 210.0]
