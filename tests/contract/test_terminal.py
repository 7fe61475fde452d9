"""Live runs that lose their terminal."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

from nlos_cam.recording import BagReader

pytestmark = [
    pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP"),
    pytest.mark.slow,
    pytest.mark.timeout(600),
]
IN_TERMINAL = """
import fcntl, signal, termios
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored under nohup
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from nlos_cam.cli import run
run()
"""
WITH_NOHUP = """
import signal
signal.signal(signal.SIGHUP, signal.SIG_IGN)
from nlos_cam.cli import run
run()
"""
ARGUMENTS = "live", "sim:bare-wall", "--no-view", "--record", "a.bag", "--log", "a.csv"
LOGGED_BYTES = 3000
INTERRUPTED = 130
Process = subprocess.Popen[bytes]


def wait_for_log(process: Process, size: int) -> None:
    """Wait until a run has logged so many bytes; fail if it ends before."""
    log = Path("a.csv")
    while not log.exists() or log.stat().st_size < size:
        assert process.poll() is None
        time.sleep(0.05)


@pytest.fixture
def started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Generator[Callable[[str, int], Process]]:
    """Start a live run with a terminal or a file, and wait until it records frames."""
    monkeypatch.chdir(tmp_path)
    processes: list[Process] = []

    def start(program: str, stream: int) -> Process:
        command = [sys.executable, "-P", "-c", program, *ARGUMENTS]
        process = subprocess.Popen(
            command, stdin=stream, stdout=stream, stderr=stream, start_new_session=True
        )
        processes.append(process)
        wait_for_log(process, LOGGED_BYTES)
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()


def test_closed_terminal_leaves_a_whole_recording(
    started: Callable[[str, int], Process], tmp_path: Path
) -> None:
    window, terminal = os.openpty()
    process = started(IN_TERMINAL, terminal)
    os.close(terminal)
    os.close(window)  # the system sends SIGHUP

    assert process.wait(60.0) == INTERRUPTED
    assert min(info.frames for info in BagReader(tmp_path / "a.bag").streams.values()) > 0


def test_run_under_nohup_outlives_its_terminal(started: Callable[[str, int], Process]) -> None:
    process = started(WITH_NOHUP, subprocess.DEVNULL)
    process.send_signal(signal.SIGHUP)
    wait_for_log(process, Path("a.csv").stat().st_size + LOGGED_BYTES)  # a second of frames
    process.terminate()

    assert process.wait(60.0) == INTERRUPTED
