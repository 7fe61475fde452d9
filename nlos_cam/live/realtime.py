"""The live loop before whatever else runs, where the system lets it: a busy browser cannot hold it up.

Linux has this for root, for whom has CAP_SYS_NICE, and for users with an `rtprio` limit (ulimit -r). Elsewhere
nothing changes, and nothing is said: the loop keeps its pace as long as there is a processor for it.

A process set up for a loop that must not be held up by its own runtime.
"""

import gc
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

LOOP, DRAWING, ORDINARY = 2, 1, 0
"""Real-time priorities, the lowest two: the loop goes before drawing, both before what has none."""
TASKS = Path("/proc/self/task")


@contextmanager
def realtime_priority() -> Generator[bool]:
    """Meanwhile all threads of this process, and those that they start, go before ordinary ones; whether they may."""
    allowed = _all_threads(LOOP)
    try:
        yield allowed
    finally:
        if allowed:
            _all_threads(ORDINARY)


def yield_to_loop() -> None:
    """From now on the calling thread goes after the loop, if that has realtime_priority, and before ordinary ones."""
    if _has_schedules() and os.sched_getscheduler(0) == os.SCHED_RR:
        _schedule(0, DRAWING)


def drop_realtime_priority() -> None:
    """From now on the calling process, which a loop with realtime_priority may have started, goes like an ordinary one."""
    if _has_schedules():
        _schedule(0, ORDINARY)


def _has_schedules() -> bool:
    return hasattr(os, "sched_setscheduler") and TASKS.is_dir()


def _all_threads(priority: int) -> bool:
    """False where that is not allowed."""
    if not _has_schedules():
        return False
    for task in TASKS.iterdir():
        try:
            _schedule(int(task.name), priority)
        except ProcessLookupError:  # it ended meanwhile
            continue
        except PermissionError:
            return False
    return True


def _schedule(task: int, priority: int) -> None:
    policy = os.SCHED_RR if priority else os.SCHED_OTHER
    os.sched_setscheduler(task, policy, os.sched_param(priority))


SWITCH_S = 0.001
"""How long a thread may keep the interpreter while others want it: at Python's 5 ms, three threads that each took their
turn could hold a frame up for half of its period."""


@contextmanager
def low_latency_interpreter() -> Generator[None]:
    """Meanwhile what is alive now is not looked through for garbage, and threads take shorter turns.

    A collection over the modules and networks of a live run takes 0.2 s: six frames. What comes later is still
    collected, so memory stays flat. Entering collects once: enter before the camera runs.
    """
    before_s = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before_s)
        gc.unfreeze()
