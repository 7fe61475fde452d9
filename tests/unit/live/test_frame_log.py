import csv
import json
import logging
from pathlib import Path
from typing import Any

import made_up_moments
import pytest

from nlos_cam.live import FrameLog
from nlos_cam.reconstruct import Verdict
from nlos_cam.view import Moment


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
        assert len(path.read_text(encoding="utf-8").splitlines()) >= 31, "written while the run goes on"
    text = path.read_text(encoding="utf-8")
    if suffix == ".csv":
        lines: list[Any] = list(csv.DictReader(text.splitlines()))
    else:
        lines = [json.loads(line) for line in text.splitlines()]
    assert [int(line["frame_number"]) for line in lines] == list(range(100))
    assert float(lines[7]["latency_ms"]) == 10.0
    assert float(lines[7]["network_ms"]) == 4.2
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


def test_log_ends_on_a_full_disk_without_ending_the_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Full:
        def write(self, _: str = "") -> int:
            raise OSError(28, "No space left on device")

        close = write

    with caplog.at_level(logging.WARNING), FrameLog(tmp_path / "log.jsonl") as log:
        real, log._file = log._file, Full()  # type: ignore[assignment]
        for number in range(5):
            log.add(moment(number))
        real.close()
    assert sum("frame 0 (No space left on device)" in line for line in caplog.messages) == 1
