"""Scheduling of the live loop: real-time priority, and an interpreter without long pauses.

Linux grants real-time priority to root, to processes with CAP_SYS_NICE, and to users with an
`rtprio` limit (ulimit -r). Elsewhere nothing changes: the loop keeps its pace as long as it has a
processor.
"""

import gc
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

LOOP = 2
DRAWING = 1
ORDINARY = 0
"""Real-time priorities, the lowest two: the loop before drawing, both before ordinary threads (0:
none).
"""
TASKS = Path("/proc/self/task")
SWITCH_S = 0.001
"""Interval at which threads hand over the interpreter: at Python's 5 ms, three threads that each
took their turn could delay a frame by half of its period."""


@contextmanager
def realtime_priority() -> Generator[bool]:
    """Give all threads of this process, and those that they start, real-time priority; yield
    whether that worked.
    """
    allowed = _all_threads(LOOP)
    try:
        yield allowed
    finally:
        if allowed:
            _all_threads(ORDINARY)


def yield_to_loop() -> None:
    """Schedule the calling thread after the loop, if that has real-time priority, and before
    ordinary threads.
    """
    if _has_schedules() and os.sched_getscheduler(0) == os.SCHED_RR:
        _schedule(0, DRAWING)


def drop_realtime_priority() -> None:
    """Schedule the calling process as an ordinary one, also if a loop with real-time priority
    started it.
    """
    if _has_schedules():
        _schedule(0, ORDINARY)


def _has_schedules() -> bool:
    return hasattr(os, "sched_setscheduler") and TASKS.is_dir()


def _all_threads(priority: int) -> bool:
    """Set the priority of all threads; return False if that is not permitted."""
    if not _has_schedules():
        return False
    for task in TASKS.iterdir():
        try:
            _schedule(int(task.name), priority)
        except ProcessLookupError:  # the thread has ended since
            continue
        except PermissionError:
            return False
    return True


def _schedule(task: int, priority: int) -> None:
    policy = os.SCHED_RR if priority else os.SCHED_OTHER
    os.sched_setscheduler(task, policy, os.sched_param(priority))


@contextmanager
def low_latency_interpreter() -> Generator[None]:
    """Exempt the objects alive now from garbage collection, and shorten the threads' turns.

    A collection over the modules and networks of a live run takes 0.2 s: six frames. Later objects
    are still collected, so memory stays flat. Entering collects once: enter before the camera runs.
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
