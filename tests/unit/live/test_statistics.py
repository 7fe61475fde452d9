import csv
import json
import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count as count_up
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import made_up_moments
import numpy as np
import pytest
from fake_wall import SMALL, wall_frame
from hypothesis import given
from hypothesis import strategies as st
from small_frames import NOTHING, small_frame

from nlos_cam.errors import NlosCamError, SceneError
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live import FrameLog, RunReport, RunStatistics, statistics
from nlos_cam.live.statistics import (
    MAX_FAILED_IN_A_ROW,
    STALLED,
    STALLED_AFTER_S,
    StallWatch,
)
from nlos_cam.reconstruct import FrameResult, Quality, QualityLog, RecentValues, Verdict, WarningLog
from nlos_cam.reconstruct.network import Uncertainty
from nlos_cam.recording.sidecar import Sidecar, Temperatures, sidecar_path
from nlos_cam.recording.telemetry import Telemetry, telemetry_of
from nlos_cam.view import Moment


def step_of(number: int, *warnings: str, **others: Any) -> FrameResult:
    frame = small_frame(number)
    given: dict[str, Any] = {"published_s": 0.0, "stages_s": {}, "warnings": warnings, **others}
    return FrameResult(frame, maps_from_frame(frame), NOTHING, **given)


def reported(
    tally: RunStatistics,
    dropped_loop: int = 0,
    issues: Mapping[str, int] = MappingProxyType({}),
    offset_s: float = 0.0,
    **camera: Any,
) -> RunReport:
    seen_through: Any = SimpleNamespace(
        **{"incomplete": 0, "dropped": 0, "counts": Counter[str](), **camera}
    )
    reader: Any = SimpleNamespace(
        dropped=list(range(dropped_loop)), offset_s=offset_s, issues=issues
    )
    return tally.report(seen_through, reader)


def test_report_of_a_run_without_frames_is_zero() -> None:
    report = reported(RunStatistics())
    assert (report.frames, report.fps, report.dropped, report.stages_ms, report.counts) == (
        0,
        0.0,
        0,
        {},
        {},
    )
    assert set(report.latency_ms.values()) == {0.0}
    assert RunStatistics().duration_s(1e9) == 0.0


def test_report_counts_verdicts_warnings_issues_and_lost_frames() -> None:
    tally = RunStatistics()
    passed = [Verdict.SEEN, None, Verdict.NOTHING, Verdict.SEEN, Verdict.WALL_MOVED]
    for number, verdict in enumerate(passed):
        tally.add(step_of(number, *["hot"] * (number > 2), verdict=verdict), view_s=0.0)
    tally.fail(small_frame(1), ZeroDivisionError("odd"), 1)
    report = reported(
        tally, 4, {"blank": 2}, incomplete=2, dropped=3, counts=Counter(duplicate=1, stalled=0)
    )
    lost = {"incomplete": 2, "dropped_camera": 3, "dropped_loop": 4, "failed": 1}
    assert (report.counts, report.dropped) == ({"duplicate": 1, **lost, "blank": 2}, 2 + 3 + 4 + 1)
    assert report.verdicts == {"object seen": 2, "nothing there": 1, "wall moved": 1}
    assert list(report.verdicts) == [verdict.value for verdict in Verdict if verdict in passed]
    assert report.warnings == {"hot": 2}


def test_statistics_raise_after_many_failures_in_a_row() -> None:
    tally = RunStatistics()
    for in_a_row in range(1, MAX_FAILED_IN_A_ROW):
        tally.fail(small_frame(in_a_row), ZeroDivisionError("an odd frame"), in_a_row)
    with pytest.raises(
        NlosCamError, match=f"{MAX_FAILED_IN_A_ROW} .*ZeroDivisionError: an odd frame"
    ):
        tally.fail(small_frame(99), ZeroDivisionError("an odd frame"), MAX_FAILED_IN_A_ROW)
    assert tally.failed == MAX_FAILED_IN_A_ROW
    with pytest.raises(SceneError, match="no object_box"):
        tally.fail(small_frame(1), SceneError("no object_box"), 1)


def test_warning_log_ignores_numbers_in_a_warning() -> None:
    found = WarningLog(told := Mock())
    for step in (
        step_of(1, "46.5 degrees"),
        step_of(2, "48 degrees"),
        step_of(3, "48 degrees", "48 mm"),
        step_of(4),
    ):
        found.add(step)
    begins = [call("46.5 degrees", True), call("48 mm", True)]
    assert told.call_args_list == [*begins, call("48 degrees", False), call("48 mm", False)]
    assert found.frames == {"48 degrees": 3, "48 mm": 1}


@given(st.lists(st.floats(0.0, 10.0), max_size=50))
def test_percentiles_rise_and_lie_among_the_times(seconds: list[float]) -> None:
    found = statistics.percentiles_ms(np.array(seconds))
    assert 0.0 <= found["p50"] <= found["p95"] <= found["p99"]
    assert found["p99"] <= 1e3 * max(seconds, default=0.0) * (1 + 1e-12)


def test_stage_times_replace_the_oldest_in_constant_memory() -> None:
    times = RecentValues(remembered=10)
    for number in range(35):
        times.add({"maps": float(number)})
        assert times._columns["maps"].size == 10
    assert sorted(times.of("maps")) == [float(number) for number in range(25, 35)]


JUST_BEFORE_S = 0.999 * STALLED_AFTER_S


def test_stall_watch_reports_a_stall_once_until_a_frame_comes() -> None:
    watch = StallWatch(told := Mock())
    assert not watch.update(1000.0, None), "no frame has come yet"
    assert not watch.update(10.0 + JUST_BEFORE_S, 10.0)
    shown = [
        time_s for time_s in (10.5, 10.6, 10.9, 11.0, 11.4, 11.6) if watch.update(time_s, 10.0)
    ]
    assert shown == [10.5, 11.0, 11.6]
    watch.frame_arrived(10.0)
    assert told.call_args_list == [call(STALLED, True)], (
        "a frame from before the stall does not end it"
    )
    watch.frame_arrived(12.0)
    watch.frame_arrived(12.1)
    assert told.call_args_list == [call(STALLED, True), call(STALLED, False)]
    assert (watch.stalls, watch.stalled_s) == (1, 2.0)


def test_stall_watch_counts_a_stall_that_lasts_to_the_end() -> None:
    watch = StallWatch(told := Mock())
    for start_s in (0.0, 10.0):
        assert watch.update(start_s + 1.0, start_s)
        watch.frame_arrived(start_s + 2.0)
    watch.update(21.0, 20.0)
    assert not watch.update(21.6, 21.5), "a frame without a result ends a stall too"
    watch.update(24.0, 23.0)
    watch.close(25.0)
    watch.close(99.0)
    assert [each.args[1] for each in told.call_args_list] == [
        True,
        False,
        True,
        False,
        True,
        False,
        True,
    ]
    assert (watch.stalls, watch.stalled_s) == (4, pytest.approx(2.0 + 2.0 + 1.5 + 2.0))


def test_predicted_quality_is_summarised_over_detected_objects_alone() -> None:
    log = QualityLog()
    assert log.summary == {}
    for number, verdict in ((6, Verdict.SEEN), (8, Verdict.SEEN), (1, Verdict.OUTSIDE)):
        share = number / 10
        quality = Quality(
            (share - 0.1, share, share + 0.1), share, share / 100, trusted=number == 8
        )
        plane = np.zeros((64, 64), np.float32)
        result = step_of(number, verdict=verdict)
        uncertainty = Uncertainty(0.0, 0.0, plane, plane, quality)
        log.add(
            replace(result, reconstruction=replace(result.reconstruction, uncertainty=uncertainty))
        )
    assert log.summary == pytest.approx(
        {"expected_iou": 0.7, "expected_error_mm": 7.0, "trusted": 0.5}
    )


def test_only_a_simulated_camera_has_computing_time() -> None:
    assert statistics.camera_ms(SimpleNamespace()) == {}  # type: ignore[arg-type]
    assert statistics.camera_ms(SimpleNamespace(exposures_s=[0.004] * 9))["p99"] == pytest.approx(4)  # type: ignore[arg-type]


FRAMES = [wall_frame(number) for number in range(1, 100, 10)]
"""A third of a second apart."""


def warming() -> Mock:
    """Telemetry that is warmer by a degree each time it is read."""
    return Mock(side_effect=({"ldd_temperature": 40.0 + read} for read in count_up(1)))


def camera(uri: str, **values: float) -> Any:
    return SimpleNamespace(
        uri=uri, telemetry=lambda end: {name: values[name] for name in values if name.endswith(end)}
    )


def readings(telemetry: Telemetry, frames: list[Frame]) -> list[Mapping[str, float] | None]:
    return [telemetry.at(frame) for frame in telemetry.watch(frames)]


def test_telemetry_reads_periodically_by_the_frames_clock() -> None:
    given = readings(Telemetry(warming(), every_s=1.0), FRAMES)
    assert [bool(celsius) for celsius in given] == [number % 3 == 0 for number in range(10)], (
        "each reading once"
    )
    assert given[3] == {"ldd_temperature": 42.0}
    late = Telemetry(asked := warming(), every_s=1.0)
    assert list(late.watch(FRAMES)) == FRAMES
    assert [call.args[0] for call in asked.call_args_list] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    first, none, last = (
        late.at(FRAMES[number]) for number in (2, 2, 9)
    )  # frames between were dropped
    assert (first, none, last) == ({"ldd_temperature": 41.0}, None, {"ldd_temperature": 44.0})


def test_telemetry_of_a_camera_reads_temperatures_only() -> None:
    warm = {"ldd_temperature": 41.0}
    assert readings(telemetry_of(camera("l515", laser_power=40.0, **warm)), FRAMES[:1]) == [warm]
    assert readings(telemetry_of(camera("sim")), FRAMES[:1]) == [None]
    assert readings(telemetry_of(camera("bag:no-sidecar.bag", **warm)), FRAMES[:1]) == [warm]


def test_telemetry_of_a_recording_reads_its_sidecar_and_warns_if_it_is_broken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = tmp_path / "wall.bag"
    series = [
        Temperatures(time_s=10.0 * k, celsius={"ldd_temperature": 40.0 + k}) for k in range(4)
    ]
    facts: dict[str, Any] = {
        "label": None,
        "camera": "l515",
        "state": "complete",
        "intrinsics": vars(SMALL),
    }
    facts |= {
        "device": {},
        "versions": {},
        "settings": {},
        "started": datetime(2026, 1, 2, tzinfo=UTC),
    }
    sidecar_path(bag).write_text(Sidecar(**facts, temperatures=series).model_dump_json())
    telemetry = telemetry_of(camera(f"bag:{bag}", ldd_temperature=99.0))
    frames = [wall_frame(300 * k) for k in range(5)]  # 10 s apart
    given = [celsius and celsius["ldd_temperature"] for celsius in readings(telemetry, frames)]
    assert given == [40.0, 41.0, 42.0, 43.0, 43.0]
    sidecar_path(bag).write_text("{")
    assert readings(telemetry_of(camera(f"bag:{bag}", ldd_temperature=39.0)), FRAMES[:2]) == [
        None,
        None,
    ]
    assert "wall.json" in caplog.text


def moment(number: int, **others: Any) -> Moment:
    given = {"stages_s": {"queue": 0.001, "network": 0.0042}, "dropped": 3, **others}
    return made_up_moments.moment(number, latency_s=0.01, **given)


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_log_writes_a_line_for_each_frame_in_order(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    with FrameLog(path) as log:
        log.add(moment(0, verdict=Verdict.SEEN, celsius={"a": 40.0, "b": 41.5}))
        for number in range(1, 100):
            log.add(moment(number))
        assert len(path.read_text(encoding="utf-8").splitlines()) >= 31, (
            "written while the run goes on"
        )
    written = path.read_text(encoding="utf-8").splitlines()
    lines: list[Any] = (
        [*csv.DictReader(written)] if suffix == ".csv" else [*map(json.loads, written)]
    )
    assert [int(line["frame_number"]) for line in lines] == list(range(100))
    assert (float(lines[7]["latency_ms"]), float(lines[7]["network_ms"])) == (10.0, 4.2)
    assert lines[0]["verdict"] == "object seen"
    assert lines[1]["verdict"] in {None, ""}
    assert float(lines[0]["celsius"]) == 41.5


def test_log_keeps_its_columns_when_a_stage_comes_later(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with FrameLog(path) as log:
        log.add(moment(0))
        log.add(moment(1, stages_s={"doubt": 1.0, "network": 0.005}))
    first, second = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
    assert (first["network_ms"], second["network_ms"], second["queue_ms"]) == ("4.2", "5.0", "")


def test_log_ends_on_a_full_disk_without_ending_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    full = OSError(28, "No space left on device")
    with caplog.at_level(logging.WARNING), FrameLog(tmp_path / "log.jsonl") as log:
        real = log._file
        log._file = Mock(**{"write.side_effect": full, "close.side_effect": full})
        for number in range(5):
            log.add(moment(number))
        real.close()
    assert sum("frame 0 (No space left on device)" in line for line in caplog.messages) == 1
