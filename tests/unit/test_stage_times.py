import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.live.statistics import StageTimes, percentiles_ms


@given(st.lists(st.floats(0.0, 10.0), max_size=50))
def test_percentiles_rise_and_lie_among_the_times(seconds: list[float]) -> None:
    found = percentiles_ms(np.array(seconds))
    assert 0.0 <= found["p50"] <= found["p95"] <= found["p99"]
    assert found["p99"] <= 1e3 * max(seconds, default=0.0) * (1 + 1e-12)


def test_the_oldest_make_room_and_memory_does_not_grow() -> None:
    times = StageTimes(remembered=10)
    for number in range(35):
        times.add({"maps": float(number)})
        assert times._columns["maps"].size == 10
    assert sorted(times.of("maps")) == [float(number) for number in range(25, 35)]


def test_a_stage_that_not_every_frame_has_is_told_of_those_that_have_it() -> None:
    times = StageTimes()
    for stages_s in ({"maps": 1.0}, {"maps": 2.0, "doubt": 5.0}, {"doubt": 6.0}):
        times.add(stages_s)
    assert times.stages == ["maps", "doubt"]
    assert sorted(times.of("maps")) == [1.0, 2.0]
    assert sorted(times.of("doubt")) == [5.0, 6.0]
    assert times.of("unheard of").size == 0


def test_a_clock_of_its_own_costs_no_precision() -> None:
    times = StageTimes()
    times.add({"latency": 1.7e9 + 0.0123})
    assert times.of("latency")[0] - 1.7e9 == pytest.approx(0.0123, abs=1e-6)
