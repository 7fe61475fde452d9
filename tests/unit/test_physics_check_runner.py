import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.frames import LidarMaps
from nlos_cam.live.physics_check_process import BackgroundPhysicsCheck
from nlos_cam.reconstruct.physics_check import check

RIG = load_rig("bare-wall")
NOTHING = np.full((64, 64), np.nan, np.float32)
DARK = LidarMaps(np.full((64, 80), np.nan, np.float32), np.zeros((64, 80), np.float32), np.zeros((64, 80), np.bool_))
SILENT = "import sys; sys.stdin.buffer.read()"
GONE = "import sys; sys.exit(3)"
DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
REFUSES = """
import pickle, sys
pickle.load(sys.stdin.buffer)
while True:
    pickle.load(sys.stdin.buffer)
    pickle.dump("no", sys.stdout.buffer)
    sys.stdout.buffer.flush()
"""
PARENT = """
import os, signal, sys, time
from nlos_calibration.rig import load_rig
from nlos_cam.physics_check_runner import BackgroundChecks
with BackgroundChecks(load_rig("bare-wall")) as checks:
    print(checks.process.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def python(code: str) -> tuple[str, ...]:
    return sys.executable, "-c", code


def until(happened: Callable[[], bool]) -> None:
    """Wait for what must come; the test's own limit of time ends what does not."""
    while not happened():
        time.sleep(0.002)


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_a_frame_is_checked_in_another_process_as_it_would_be_here() -> None:
    told = list[str]()
    with BackgroundPhysicsCheck(RIG, accuracy="draft", on_error=told.append) as checks:
        assert checks.newest is None
        checks.offer(5, DARK, NOTHING)
        until(lambda: checks.newest is not None or bool(told))
        assert checks.process is not None
        if hasattr(os, "getpriority"):
            assert os.getpriority(os.PRIO_PROCESS, checks.process.pid) == 19
    assert not told
    assert checks.newest is not None
    assert checks.newest.frame_number == 5
    assert checks.newest.score == check(DARK, NOTHING, RIG, accuracy="draft").score
    assert checks.process.returncode is not None


def test_a_frame_is_due_once_a_period_and_the_newest_takes_the_place_of_one_that_waits() -> None:
    clock = Clock()
    with BackgroundPhysicsCheck(RIG, period_s=2.0, clock=clock, command=python(SILENT)) as checks:
        checks.offer(1, DARK, NOTHING)
        until(lambda: not checks.waits)
        for number, (later_s, waits, dropped) in enumerate(
            [(1.9, False, 0), (0.2, True, 0), (1.0, True, 0), (1.5, True, 1)]
        ):
            clock.now_s += later_s
            checks.offer(2 + number, DARK, NOTHING)
            assert (checks.waits, checks.dropped) == (waits, dropped)


def test_a_process_that_never_answers_holds_nobody_up_and_is_gone_at_the_end() -> None:
    with BackgroundPhysicsCheck(RIG, period_s=0.0, clock=Clock(), command=python(SILENT)) as checks:
        for number in range(1000):
            checks.offer(number, DARK, NOTHING)
        assert checks.dropped >= 1000 - 3
        assert checks.newest is None
    assert checks.process is not None
    assert checks.process.returncode is not None


def test_a_process_that_will_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.live.physics_check_process.END_WITHIN_S", 0.2)
    with BackgroundPhysicsCheck(RIG, command=python(DEAF)) as checks:
        checks.offer(0, DARK, NOTHING)
        until(lambda: checks.over)  # what it printed is no answer
    assert checks.process is not None
    assert checks.process.returncode == (1 if sys.platform == "win32" else -9)


def test_a_check_that_fails_is_told_once_and_later_frames_are_asked_for() -> None:
    told = list[str]()
    with BackgroundPhysicsCheck(
        RIG, period_s=0.0, clock=Clock(), command=python(REFUSES), on_error=told.append
    ) as checks:
        for number in range(4):
            checks.offer(number, DARK, NOTHING)
            until(lambda: not checks.waits)
        until(lambda: bool(told))
        assert not checks.over
    assert told == ["the physics check of frame 0 failed (no): frames go on without"]


@pytest.mark.parametrize(
    ("command", "why"), [(python(GONE), "their process ended"), (("/no/such/python",), "cannot be started")]
)
def test_a_process_that_is_not_there_is_told_once_and_frames_go_on(command: tuple[str, ...], why: str) -> None:
    told = list[str]()
    with BackgroundPhysicsCheck(RIG, period_s=0.0, clock=Clock(), command=command, on_error=told.append) as checks:
        checks.offer(0, DARK, NOTHING)
        until(lambda: checks.over)
        checks.offer(1, DARK, NOTHING)
        assert not checks.waits
    assert len(told) == 1
    assert why in told[0]
    assert checks.newest is None


def test_an_end_by_us_is_no_error() -> None:
    told = list[str]()
    with BackgroundPhysicsCheck(RIG, command=python(SILENT), on_error=told.append) as checks:
        checks.offer(0, DARK, NOTHING)
    assert not told


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
def test_the_process_ends_with_a_parent_that_is_killed() -> None:
    # it holds our pipe as long as it lives: without its end this would wait for ever
    done = subprocess.run(
        python(PARENT), capture_output=True, check=False, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    assert done.returncode == -9
    assert int(done.stdout) > 0


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are POSIX")
def test_a_ctrl_c_at_the_terminal_does_not_reach_it() -> None:
    with BackgroundPhysicsCheck(RIG, command=python(SILENT)) as checks:
        assert checks.process is not None
        assert os.getpgid(checks.process.pid) != os.getpgrp()
