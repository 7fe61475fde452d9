from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.errors import NlosCamError, SceneError
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live.statistics import MAX_FAILED_IN_A_ROW, Held, RunReport, RunStatistics, Warned
from nlos_cam.reconstruct.network import Reconstruction
from nlos_cam.reconstruct.pipeline import FrameResult
from nlos_cam.reconstruct.verdict import Verdict

SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)
NOTHING = Reconstruction(np.full((64, 64), np.nan, np.float32), np.eye(4), None, {})


def frame(number: int) -> Frame:
    depth_m, ir = np.full((64, 80), 0.3, np.float32), np.full((64, 80), 9, np.uint8)
    return Frame(depth_m, ir, ir, number / 30, number, SMALL)


def reported(
    tally: RunStatistics, camera: dict[str, Any] | None = None, dropped: int = 0, offset_s: float = 0.0
) -> RunReport:
    of_camera = {"incomplete": 0, "dropped": 0, "counts": Counter[str](), **(camera or {})}
    reader: Any = SimpleNamespace(dropped=list(range(dropped)), offset_s=offset_s)
    seen_through: Any = SimpleNamespace(**of_camera)
    return tally.report(seen_through, reader)


def tally_of(ages_s: list[float]) -> RunStatistics:
    """A frame every thirtieth of a second, each published so long after its timestamp."""
    tally = RunStatistics()
    for number, age_s in enumerate(ages_s):
        one = frame(number)
        stages_s = {"wait": 0.001, "network": 0.01 * (number + 1)}
        tally.add(FrameResult(one, maps_from_frame(one), NOTHING, one.timestamp_s + age_s, stages_s), view_s=0.002)
    return tally


def test_a_run_without_a_frame_reports_zeros() -> None:
    report = reported(RunStatistics())
    assert (report.frames, report.fps, report.dropped, report.stages_ms, report.counts) == (0, 0.0, 0, {}, {})
    assert set(report.latency_ms.values()) == {0.0}


def test_rate_latency_and_stages_are_those_of_the_frames() -> None:
    report = reported(tally_of([0.005] * 31), offset_s=0.002)
    assert report.frames == 31
    assert report.fps == pytest.approx(30.0)
    assert report.latency_ms == pytest.approx({"p50": 3.0, "p95": 3.0, "p99": 3.0}, abs=1e-6)
    assert report.stages_ms == pytest.approx({"wait": 1.0, "network": 160.0, "view": 2.0})


def test_each_verdict_is_counted_by_frames() -> None:
    tally, passed = RunStatistics(), [Verdict.SEEN, None, Verdict.NOTHING, Verdict.SEEN, Verdict.WALL_MOVED]
    for number, verdict in enumerate(passed):
        tally.add(replace(warned(number), verdict=verdict), view_s=0.0)
    verdicts = reported(tally).verdicts
    assert verdicts == {"object seen": 2, "nothing there": 1, "wall moved": 1}
    assert list(verdicts) == [verdict.value for verdict in Verdict if verdict in passed]


def test_delivery_is_told_by_the_loops_clock_and_a_step_without_an_arrival_has_none() -> None:
    tally = RunStatistics()
    for number in range(9):
        step = warned(number)
        tally.add(replace(step, published_s=number / 30 + 0.012, arrived_s=number / 30 + 0.007), view_s=0.0)
    report = reported(tally, offset_s=0.005)
    assert report.stages_percentiles_ms["delivery"] == pytest.approx({"p50": 2.0, "p95": 2.0, "p99": 2.0}, abs=1e-6)
    assert report.latency_ms["p99"] == pytest.approx(7.0, abs=1e-6)
    assert "delivery" not in reported(tally_of([0.1])).stages_ms


def test_a_run_lasts_from_its_first_result() -> None:
    assert RunStatistics().lasted_s(1e9) == 0.0
    assert tally_of([0.5, 0.1]).lasted_s(4.5) == pytest.approx(4.0)


def test_counts_say_what_was_seen_and_where_frames_were_lost() -> None:
    tally = RunStatistics()
    tally.seen.update(["blank", "blank"])
    tally.fail(frame(1), ZeroDivisionError("odd"), 1)
    report = reported(tally, {"incomplete": 2, "dropped": 3, "counts": Counter(duplicate=1, stalled=0)}, dropped=4)
    assert report.counts == {
        "duplicate": 1,
        "incomplete": 2,
        "dropped_camera": 3,
        "dropped_loop": 4,
        "failed": 1,
        "blank": 2,
    }
    assert report.dropped == 2 + 3 + 4 + 1


def test_frames_that_fail_are_borne_until_they_are_many_in_a_row() -> None:
    tally = RunStatistics()
    for in_a_row in range(1, MAX_FAILED_IN_A_ROW):
        tally.fail(frame(in_a_row), ZeroDivisionError("an odd frame"), in_a_row)
    with pytest.raises(NlosCamError, match=f"{MAX_FAILED_IN_A_ROW} frames in a row .*ZeroDivisionError: an odd frame"):
        tally.fail(frame(99), ZeroDivisionError("an odd frame"), MAX_FAILED_IN_A_ROW)
    assert tally.failed == MAX_FAILED_IN_A_ROW


def warned(number: int, *warnings: str) -> FrameResult:
    one = frame(number)
    return FrameResult(one, maps_from_frame(one), NOTHING, 0.0, {}, warnings=warnings)


def test_a_warning_is_told_when_it_begins_and_when_it_ends_and_its_frames_are_counted() -> None:
    told = list[tuple[str, bool]]()
    found = Warned(lambda *about: told.append(about))
    for step in (warned(7), warned(8, "hot"), warned(9, "hot", "moved"), warned(11, "moved"), warned(12)):
        found.add(step)
    assert told == [("hot", True), ("moved", True), ("hot", False), ("moved", False)]
    assert found.held == [Held("hot", 2, 8, 9), Held("moved", 2, 9, 11)]
    found.add(warned(20, "hot"))
    assert told[-1] == ("hot", True)
    assert found.held[0] == Held("hot", 3, 8, 20)


def test_a_warning_whose_figures_change_is_the_same_one() -> None:
    told = list[tuple[str, bool]]()
    found = Warned(lambda *about: told.append(about))
    for step in (warned(1, "46.5 degrees"), warned(2, "48 degrees"), warned(3, "48 degrees", "48 mm"), warned(4)):
        found.add(step)
    assert told == [("46.5 degrees", True), ("48 mm", True), ("48 degrees", False), ("48 mm", False)]
    assert found.frames() == {"48 degrees": 3, "48 mm": 1}


def test_a_report_says_for_how_many_frames_each_warning_held() -> None:
    tally = RunStatistics()
    for step in (warned(1), warned(2, "hot"), warned(3, "hot")):
        tally.add(step, view_s=0.0)
    assert reported(tally).warnings == {"hot": 2}


def test_an_error_that_is_not_the_frames_is_not_borne() -> None:
    with pytest.raises(SceneError, match="no object_box"):
        RunStatistics().fail(frame(1), SceneError("no object_box"), 1)
