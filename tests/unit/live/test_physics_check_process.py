import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from io import BytesIO
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.frames import LidarMaps
from nlos_cam.live.physics_check_process import BackgroundPhysicsCheck, main, serve
from nlos_cam.reconstruct.physics_check import check_reconstruction

RIG = load_rig("bare-wall")
NOTHING = np.full((64, 64), np.nan, np.float32)
DARK = LidarMaps(
    np.full((64, 80), np.nan, np.float32),
    np.zeros((64, 80), np.float32),
    np.zeros((64, 80), np.bool_),
)
LIT = LidarMaps(
    np.full((64, 80), 0.3, np.float32),
    np.full((64, 80), 40.0, np.float32),
    np.ones((64, 80), np.bool_),
)
SILENT = "import sys; sys.stdin.buffer.read()"
GONE = "import sys; sys.exit(3)"
DEAF = (
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True);"
    " time.sleep(600)"
)
REFUSES = """
import pickle, sys
pickle.load(sys.stdin.buffer)
while True:
    pickle.load(sys.stdin.buffer)
    pickle.dump("no", sys.stdout.buffer)
    sys.stdout.buffer.flush()
"""
REFUSES_ONCE = """
import pickle, sys
pickle.load(sys.stdin.buffer)
pickle.load(sys.stdin.buffer)
pickle.dump("no", sys.stdout.buffer)
sys.stdout.buffer.flush()
pickle.load(sys.stdin.buffer)
sys.exit(3)
"""
PARENT = """
import os, signal, sys, time
from nlos_calibration.rig import load_rig
from nlos_cam.live import BackgroundPhysicsCheck
with BackgroundPhysicsCheck(load_rig("bare-wall")) as checks:
    print(checks.process.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def python(code: str) -> tuple[str, ...]:
    return sys.executable, "-c", code


def wait_until(happened: Callable[[], bool]) -> None:
    """Poll; the test's own time limit ends a wait in vain."""
    while not happened():
        time.sleep(0.002)


def test_background_check_equals_a_check_in_this_process() -> None:
    errors = list[str]()
    with BackgroundPhysicsCheck(RIG, accuracy="draft", on_error=errors.append) as checks:
        assert checks.newest is None
        checks.offer(5, DARK, NOTHING)
        wait_until(lambda: checks.newest is not None or bool(errors))
        if hasattr(os, "getpriority"):
            assert os.getpriority(os.PRIO_PROCESS, checks.process.pid) == 19

    assert not errors
    assert checks.newest.frame_number == 5
    assert checks.newest.score == check_reconstruction(DARK, NOTHING, RIG, accuracy="draft").score
    assert checks.process.returncode is not None


def test_background_check_compares_with_the_rig_in_use() -> None:
    paper = load_rig("paper-rig")
    with BackgroundPhysicsCheck(RIG, accuracy="draft") as checks:
        checks.use_rig(paper)
        checks.offer(5, LIT, NOTHING)
        wait_until(lambda: checks.newest is not None or checks.ended)

    residual_m = checks.newest.residual_depth_m
    by_paper, by_start = (check_reconstruction(LIT, NOTHING, rig) for rig in (paper, RIG))

    np.testing.assert_array_equal(residual_m, by_paper.residual_depth_m)
    assert not np.array_equal(residual_m, by_start.residual_depth_m, equal_nan=True)


def test_background_checks_take_the_newest_frame_once_a_period() -> None:
    now_s = 100.0
    steps = [(1.9, False, 0), (0.2, True, 0), (1.0, True, 0), (1.5, True, 1)]
    with BackgroundPhysicsCheck(
        RIG, period_s=2.0, clock=lambda: now_s, command=python(SILENT)
    ) as checks:
        checks.offer(1, DARK, NOTHING)
        wait_until(lambda: not checks.waits)
        for number, (later_s, waits, dropped) in enumerate(steps, 2):
            now_s += later_s
            checks.offer(number, DARK, NOTHING)
            assert (checks.waits, checks.dropped) == (waits, dropped)


def background(command: tuple[str, ...]) -> tuple[BackgroundPhysicsCheck, list[str]]:
    """Checks in a process of that command, always due, and the errors that they report."""
    errors = list[str]()
    run: Any = {
        "period_s": 0.0,
        "clock": lambda: 100.0,
        "command": command,
        "on_error": errors.append,
    }
    return BackgroundPhysicsCheck(RIG, **run), errors


def test_background_checks_never_wait_for_their_process() -> None:
    checks, errors = background(python(SILENT))
    with checks:
        for number in range(1000):
            checks.offer(number, DARK, NOTHING)
        assert checks.dropped >= 1000 - 3
        assert checks.newest is None
        if sys.platform != "win32":
            assert os.getpgid(checks.process.pid) != os.getpgrp(), (
                "Ctrl-C at the terminal reaches it"
            )

    assert checks.process.returncode is not None
    assert not errors, "its end by us is no error"


def test_background_checks_kill_a_process_that_will_not_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("nlos_cam.live.physics_check_process.END_WITHIN_S", 0.2)
    with BackgroundPhysicsCheck(RIG, command=python(DEAF)) as checks:
        checks.offer(0, DARK, NOTHING)
        wait_until(lambda: checks.ended)  # what it printed is no answer

    assert checks.process.returncode == (1 if sys.platform == "win32" else -9)


def test_background_checks_report_a_failure_once_and_go_on() -> None:
    checks, errors = background(python(REFUSES))
    with checks:
        for number in range(4):
            checks.offer(number, DARK, NOTHING)
            wait_until(lambda: not checks.waits)
        wait_until(lambda: bool(errors))
        assert not checks.ended
    (error,) = errors

    assert "frame 0" in error
    assert "(no)" in error


@pytest.mark.parametrize("command", [python(GONE), ("/no/such/python",)])
def test_background_checks_report_a_missing_process_once(command: tuple[str, ...]) -> None:
    checks, errors = background(command)
    with checks:
        checks.offer(0, DARK, NOTHING)
        wait_until(lambda: checks.ended)
        checks.offer(1, DARK, NOTHING)
        assert not checks.waits

    assert (len(errors), checks.newest) == (1, None)


def test_background_checks_report_their_end_after_a_failure() -> None:
    checks, errors = background(python(REFUSES_ONCE))
    with checks:
        checks.offer(0, DARK, NOTHING)
        wait_until(lambda: bool(errors))
        checks.offer(1, DARK, NOTHING)
        wait_until(lambda: checks.ended)
    failed, ended = errors

    assert "frame 0" in failed
    assert "no more" in ended


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
@pytest.mark.slow
def test_background_process_ends_with_a_killed_parent() -> None:
    # the process holds our pipe as long as it lives: `run` returns only once it has ended
    done = subprocess.run(
        python(PARENT),
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )

    assert done.returncode == -9
    assert int(done.stdout) > 0


def answers(*frames: object, end: bytes = b"") -> list[Any]:
    left = Event()
    asked = BytesIO(b"".join(pickle.dumps(each) for each in ("draft", *frames)) + end)
    told = BytesIO()
    serve(asked, told, left.set)
    assert left.wait(10.0)
    told.seek(0)
    found = list[Any]()
    while told.tell() < len(told.getvalue()):
        found.append(pickle.load(told))  # noqa: S301  what we wrote ourselves
    return found


def test_worker_answers_each_frame_in_order_or_names_its_error() -> None:
    found, error, later = answers(
        (4, DARK, NOTHING, RIG), (1, "no maps", NOTHING, RIG), (9, DARK, NOTHING, RIG)
    )

    assert found.frame_number == 4
    assert later.frame_number == 9
    assert found.score == check_reconstruction(DARK, NOTHING, RIG, accuracy="draft").score
    assert error.startswith("AttributeError: ")


@pytest.mark.parametrize("end", [b"", pickle.dumps((3, DARK, NOTHING, RIG))[:-9], b"not a pickle"])
def test_worker_leaves_when_its_parent_is_gone(end: bytes) -> None:
    assert len(answers((1, DARK, NOTHING, RIG), end=end)) == 1


def test_worker_is_nice_and_keeps_prints_out_of_its_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    niced = []
    served = []
    monkeypatch.setattr(os, "nice", niced.append, raising=False)
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, SimpleNamespace(buffer=name))
    monkeypatch.setattr(
        "nlos_cam.live.physics_check_process.serve",
        lambda asked, told, leave: served.append((asked, told, sys.stdout.buffer, callable(leave))),
    )
    main()

    assert niced == [19]
    assert served == [("stdin", "stdout", "stderr", True)]
