from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_frames import result_of, small_frame

from nlos_cam.errors import NlosCamError, SceneError
from nlos_cam.live import RunReport, RunStatistics
from nlos_cam.live.statistics import (
    MAX_FAILED_IN_A_ROW,
    SLOW_FRAMES,
    STALLED,
    STALLED_AFTER_S,
    PaceWatch,
    StallWatch,
    camera_ms,
    percentiles_ms,
)
from nlos_cam.reconstruct import Verdict

JUST_BEFORE_S = 0.999 * STALLED_AFTER_S


def reported(
    statistics: RunStatistics,
    dropped_loop: int = 0,
    issues: Mapping[str, int] = MappingProxyType({}),
    **camera: Any,
) -> RunReport:
    counters = {"incomplete": 0, "dropped": 0, "counts": Counter[str](), **camera}
    reader: Any = SimpleNamespace(dropped=dropped_loop, offset_s=0.0, issues=issues)
    lidar: Any = SimpleNamespace(**counters)
    return statistics.report(lidar, reader)


def test_report_of_a_run_without_frames_is_zero() -> None:
    report = reported(RunStatistics())

    assert report.frames == 0
    assert report.fps == 0.0
    assert report.dropped == 0
    assert report.stages_ms == {}
    assert report.counts == {}
    assert set(report.latency_ms.values()) == {0.0}
    assert RunStatistics().duration_s(1e9) == 0.0


def test_report_counts_verdicts_in_their_order() -> None:
    statistics = RunStatistics()
    for verdict in (Verdict.SEEN, None, Verdict.NOTHING, Verdict.SEEN, Verdict.WALL_MOVED):
        statistics.add(result_of(small_frame(0), verdict=verdict), view_s=0.0)
    verdicts = reported(statistics).verdicts

    assert verdicts == {"object seen": 2, "nothing there": 1, "wall moved": 1}
    assert list(verdicts) == ["object seen", "nothing there", "wall moved"]


def test_report_counts_frames_by_warning() -> None:
    statistics = RunStatistics()
    for warnings in ((), ("hot",), ("hot",)):
        statistics.add(result_of(small_frame(0), warnings=warnings), view_s=0.0)

    assert reported(statistics).warnings == {"hot": 2}


def test_report_counts_lost_frames_by_cause_and_issues() -> None:
    statistics = RunStatistics()
    statistics.fail(small_frame(1), ZeroDivisionError("odd"), 1)
    counts = Counter(duplicate=1, stalled=0)
    report = reported(statistics, 4, {"blank": 2}, incomplete=2, dropped=3, counts=counts)
    lost = {"incomplete": 2, "dropped_camera": 3, "dropped_loop": 4, "failed": 1}

    assert report.counts == {"duplicate": 1, **lost, "blank": 2}
    assert report.dropped == sum(lost.values())


def test_statistics_raise_after_many_failures_in_a_row() -> None:
    statistics = RunStatistics()
    odd = ZeroDivisionError("an odd frame")
    for in_a_row in range(1, MAX_FAILED_IN_A_ROW):
        statistics.fail(small_frame(in_a_row), odd, in_a_row)
    with pytest.raises(NlosCamError, match=f"{MAX_FAILED_IN_A_ROW} .*ZeroDivisionError: an odd"):
        statistics.fail(small_frame(99), odd, MAX_FAILED_IN_A_ROW)

    assert statistics.failed == MAX_FAILED_IN_A_ROW


def test_statistics_raise_an_error_that_is_not_the_frames() -> None:
    with pytest.raises(SceneError, match="no object_box"):
        RunStatistics().fail(small_frame(1), SceneError("no object_box"), 1)


@given(st.lists(st.floats(0.0, 10.0), max_size=50))
def test_percentiles_rise_and_lie_among_the_times(seconds: list[float]) -> None:
    found = percentiles_ms(np.array(seconds))

    assert 0.0 <= found["p50"] <= found["p95"] <= found["p99"]
    assert found["p99"] <= 1e3 * max(seconds, default=0.0) * (1 + 1e-12)


def test_stall_watch_needs_a_frame_and_the_whole_time() -> None:
    watch = StallWatch(Mock())

    assert not watch.update(1000.0, None), "no frame has come yet"
    assert not watch.update(10.0 + JUST_BEFORE_S, 10.0)


def test_stall_is_shown_again_after_the_same_time() -> None:
    watch = StallWatch(Mock())
    times_s = (10.5, 10.6, 10.9, 11.0, 11.4, 11.6)

    assert [time_s for time_s in times_s if watch.update(time_s, 10.0)] == [10.5, 11.0, 11.6]


def test_stall_watch_reports_a_stall_once_until_a_frame_comes() -> None:
    on_stall = Mock()
    watch = StallWatch(on_stall)
    for time_s in (10.5, 11.0):
        watch.update(time_s, 10.0)
    watch.frame_arrived(10.0)

    assert on_stall.call_args_list == [call(STALLED, True)], "that frame came before the stall"

    watch.frame_arrived(12.0)
    watch.frame_arrived(12.1)

    assert on_stall.call_args_list == [call(STALLED, True), call(STALLED, False)]
    assert watch.stalls == 1
    assert watch.stalled_s == 2.0


def test_stall_watch_counts_a_stall_that_lasts_to_the_end() -> None:
    on_stall = Mock()
    watch = StallWatch(on_stall)
    for start_s in (0.0, 10.0):
        assert watch.update(start_s + 1.0, start_s)
        watch.frame_arrived(start_s + 2.0)
    watch.update(21.0, 20.0)

    assert not watch.update(21.6, 21.5), "a frame without a result ends a stall too"

    watch.update(24.0, 23.0)
    watch.close(25.0)
    watch.close(99.0)

    assert [each.args[1] for each in on_stall.call_args_list] == [True, False] * 3 + [True]
    assert watch.stalls == 4
    assert watch.stalled_s == pytest.approx(2.0 + 2.0 + 1.5 + 2.0)


def watched_pace() -> tuple[PaceWatch, list[tuple[str, bool]]]:
    """Pace of a run that was quick, and is slow now."""
    warnings: list[tuple[str, bool]] = []
    watch = PaceWatch(lambda text, begins: warnings.append((text, begins)))
    for frames in range(0, 4 * SLOW_FRAMES, 10):
        watch.update(frames, 0)
    assert warnings == []
    for frames in range(0, 2 * SLOW_FRAMES, 10):
        watch.update(4 * SLOW_FRAMES + frames, frames // 2)
    return watch, warnings


def test_pace_watch_warns_once_and_names_a_remedy() -> None:
    watch, [(warning, begins)] = watched_pace()

    assert begins
    assert "taskset" in warning
    assert watch.warnings


def test_pace_warning_ends_when_no_more_frames_are_dropped() -> None:
    watch, warnings = watched_pace()
    for frames in range(0, 3 * SLOW_FRAMES, 10):
        watch.update(6 * SLOW_FRAMES + frames, SLOW_FRAMES)

    assert [begins for _, begins in warnings] == [True, False]
    assert watch.warnings == ()


def test_only_a_simulated_camera_has_computing_time() -> None:
    computed: Any = SimpleNamespace(exposures_s=[0.004] * 9)
    real: Any = SimpleNamespace()

    assert camera_ms(computed)["p99"] == pytest.approx(4.0)
    assert camera_ms(real) == {}
