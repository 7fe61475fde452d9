import csv
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import made_up_moments
import pytest
from made_up_moments import with_result

from nlos_cam.live import FrameLog
from nlos_cam.reconstruct import Verdict
from nlos_cam.view import Moment

STAGES_S = {"queue": 0.001, "network": 0.0042}


def moment(number: int, **result: Any) -> Moment:
    known = with_result(made_up_moments.moment(number), **{"stages_s": STAGES_S, **result})
    return replace(known, latency_s=0.01, celsius={"a": 40.0, "b": 41.5})


def lines_of(path: Path) -> list[dict[str, Any]]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [*csv.DictReader(lines)] if path.suffix == ".csv" else [*map(json.loads, lines)]


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_log_has_a_line_for_each_frame_in_order(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    with FrameLog(path) as log:
        for number in range(100):
            log.add(moment(number))
        assert len(path.read_text(encoding="utf-8").splitlines()) >= 31, "flushed during the run"

    assert [int(line["frame_number"]) for line in lines_of(path)] == list(range(100))


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_log_line_holds_times_verdict_and_warmest_reading(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    with FrameLog(path) as log:
        log.add(moment(0, verdict=Verdict.SEEN))
        log.add(moment(1))
    line, other = lines_of(path)

    assert float(line["latency_ms"]) == 10.0
    assert float(line["network_ms"]) == 4.2
    assert float(line["celsius"]) == 41.5
    assert line["verdict"] == "object seen"
    assert other["verdict"] in {None, ""}


@pytest.mark.parametrize("none", [float("nan"), -9999.0])
def test_log_leaves_out_a_temperature_that_is_none(tmp_path: Path, none: float) -> None:
    path = tmp_path / "log.jsonl"
    with FrameLog(path) as log:
        log.add(replace(moment(0), celsius={"ldd_temperature": none}))

    (line,) = lines_of(path)

    assert line["celsius"] is None


def test_log_keeps_its_columns_when_a_stage_comes_later(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with FrameLog(path) as log:
        log.add(moment(0))
        log.add(moment(1, stages_s={"doubt": 1.0, "network": 0.005}))
    first, second = lines_of(path)

    assert first["network_ms"] == "4.2"
    assert second["network_ms"] == "5.0"
    assert second["queue_ms"] == ""


def test_earlier_log_stays_until_the_first_frame(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("an earlier run's\n")
    with FrameLog(path):
        pass
    assert path.read_text() == "an earlier run's\n"

    with FrameLog(path) as log:
        log.add(moment(7))
    assert [line["frame_number"] for line in lines_of(path)] == ["7"]


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
