"""Commands whose processes are killed, whose output another one writes, or whose clock jumps."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from live_process import children_of

from nlos_cam.dataset import open_dataset
from nlos_cam.recording.bag_reader import SAMPLE

pytestmark = [
    pytest.mark.skipif(
        not Path("/proc/self/stat").is_file(), reason="lists processes as Linux does"
    ),
    pytest.mark.slow,
    pytest.mark.timeout(600),
]
PROGRAM = "from nlos_cam.cli import run\nif __name__ == '__main__': run()"
JUMP_S = 3600.0
JUMPING = f"""
import time
start_s = time.monotonic()
of_day = time.time
jumps_s = 0.0, {JUMP_S}, -{JUMP_S}
time.time = lambda: of_day() + jumps_s[int(2.0 * (time.monotonic() - start_s)) % 3]
{PROGRAM}
"""
WITHIN_S = 300.0
LIVE = "live", "sim:bare-wall", "--seconds", "4", "--no-view", "--json"


def begin(folder: Path, *arguments: str, program: str = PROGRAM) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", "-c", program, *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def last_line(process: subprocess.Popen[str]) -> dict[str, Any]:
    out, err = process.communicate(timeout=WITHIN_S)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


def test_second_replay_into_a_folder_names_the_first(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(SAMPLE.read_bytes())
    both = [begin(tmp_path, "replay", "a.bag", "--out", "out") for _ in range(2)]
    errors = {process.communicate(timeout=WITHIN_S)[1]: process for process in both}
    codes = sorted(process.returncode for process in both)

    assert codes == [0, 1]

    refusal = next(error for error, process in errors.items() if process.returncode)
    winner = next(process for process in both if not process.returncode)

    assert f"process {winner.pid}" in refusal or "exists" in refusal
    assert (tmp_path / "out" / "report.html").is_file()
    assert not list(tmp_path.glob(".*.part"))


def test_dataset_outlives_a_killed_worker(tmp_path: Path) -> None:
    arguments = "dataset", "build", "--count", "120", "--workers", "2", "--out", "data"
    building = begin(tmp_path, *arguments)
    workers: list[int] = []
    while len(workers) < 3 and building.poll() is None:  # with the resource tracker
        workers = children_of(building.pid)
        time.sleep(0.05)
    time.sleep(1.0)
    os.kill(max(workers), signal.SIGKILL)
    _, err = building.communicate(timeout=WITHIN_S)

    assert building.returncode == 0, err
    assert len(open_dataset(tmp_path / "data").column("seed")) == 120


def test_live_run_goes_on_while_the_time_of_day_jumps(tmp_path: Path) -> None:
    report = last_line(begin(tmp_path, *LIVE, program=JUMPING))

    assert report["frames"] > 30
    # less than a jump, however slow the machine is
    assert 0.0 <= report["stalled_s"] < JUMP_S / 2
    assert 0.0 <= report["latency_ms"]["p50"] <= report["latency_ms"]["p99"] < 1e3 * JUMP_S / 2
