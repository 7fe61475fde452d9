"""Live runs that record, log and serve their view, interrupted while they start or run."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from live_process import LiveProcess

from nlos_cam.errors import RecordingError
from nlos_cam.recording import BagReader, repair_recording

pytestmark = [
    pytest.mark.skipif(
        not Path("/proc/self/stat").is_file(), reason="lists processes as Linux does"
    ),
    pytest.mark.slow,
    pytest.mark.timeout(900),
]
EARLY_S = 0.5
LATE_S = 8.0
"""Seconds after the process begins: during its start, and mostly while it runs."""
WATCHED_S = 2.0
RUN_S = 12.0
TIMEOUT_S = 300.0
INTERRUPTED = 130
SCENE = 'name = "a wall"\nrig = "bare-wall"\n'
UNPLUG = '[[faults]]\nkind = "unplug"\nat_frame = 5\nframes = 1_000_000\n'
WATCHER = """
import sys, urllib.request
with urllib.request.urlopen(sys.argv[1].partition("#")[0] + "stream") as stream:
    print("watching", flush=True)
    while stream.read(1 << 16):
        pass
"""


def watch_and_be_killed(address: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", WATCHER, address], stdout=subprocess.PIPE
    ) as watcher:
        assert watcher.stdout
        watcher.stdout.readline()
        time.sleep(WATCHED_S)
        watcher.kill()


def frames_in(bag: Path) -> int:
    """Count the frames of the shortest stream. Raises RecordingError where it can be neither read
    nor repaired.
    """
    try:
        return min((info.frames for info in BagReader(bag).streams.values()), default=0)
    except RecordingError:
        return min(
            repair_recording(bag, bag.with_name("repaired.bag")).recovered_frames.values(),
            default=0,
        )


def assert_log_is_whole(log: Path) -> None:
    text = log.read_text(encoding="utf-8")
    assert text.endswith("\n") or not text


@pytest.mark.parametrize(
    ("kind", "after_s", "view"),
    [
        ("ctrl-c", EARLY_S, True),
        ("terminate", LATE_S, True),
        ("viewer killed", LATE_S, True),
        ("unplugged, then ctrl-c", LATE_S, False),
    ],
)
def test_interrupted_live_leaves_no_process_or_partial_file(
    tmp_path: Path, kind: str, after_s: float, view: bool
) -> None:
    scene = tmp_path / "scene.toml"
    bag = tmp_path / "run.bag"
    log = tmp_path / "run.csv"
    scene.write_text(SCENE + UNPLUG * kind.startswith("unplugged"), encoding="utf-8")
    is_watched = kind == "viewer killed"
    options = ["--seconds", str(RUN_S)] * is_watched + ["--no-view"] * (not view)
    with LiveProcess(
        [f"sim:{scene}", "--json", "--record", str(bag), "--log", str(log), *options]
    ) as run:
        run.wait_until_begun(TIMEOUT_S)
        if is_watched:
            watch_and_be_killed(run.wait_for_address(TIMEOUT_S))
        else:
            time.sleep(after_s)
            run.process.send_signal(signal.SIGTERM if kind == "terminate" else signal.SIGINT)
        assert run.ended_within(2 * TIMEOUT_S) is not None
        assert not run.left()
        assert run.process.returncode == (0 if is_watched else INTERRUPTED)
        stdout = run.stdout

    assert not [path for path in tmp_path.rglob("*") if ".part" in path.name]

    if log.exists():  # the run had begun
        assert_log_is_whole(log)
        assert {"frames", "error"} & json.loads(stdout.splitlines()[-1]).keys()
    recorded = frames_in(bag) if bag.exists() else 0  # what there is can be read
    if is_watched:
        assert recorded > 0
        assert len(log.read_text(encoding="utf-8").splitlines()) > 1
