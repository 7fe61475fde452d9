"""Scheduling of the live loop: real-time priority, and an interpreter without long pauses.

Linux grants real-time priority to root, to processes with CAP_SYS_NICE, and to users with an
`rtprio` limit (ulimit -r). Elsewhere nothing changes: the loop keeps its pace as long as it has a
processor.

A thread with real-time priority that never waits keeps every ordinary thread of the machine from
its processor. The priority is therefore not taken on one processor, and given up while a command of
the page waits, once the run is too slow, and when it ends.
"""

import gc
import logging
import os
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from threading import enumerate as enumerate_threads
from typing import Literal, Self

LOOP = 2
DRAWING = 1
ORDINARY = 0
"""Real-time priorities, the lowest two: the loop before drawing, both before ordinary threads (0:
none).
"""
TASKS = Path("/proc/self/task")
MIN_PROCESSORS = 2
GIVE_WAY = 8
"""`nice` of the run's threads on one processor. The kernel gives 8 a sixth of the weight of 0: the
four busy threads of a run (camera, loop, network, drawing) together get two thirds as much as
another program, which leaves room for the threads that answer the page."""
POLL_S = 0.1
Priority = Literal["auto", "never"]
SWITCH_S = 0.001
"""Interval at which threads hand over the interpreter: at Python's 5 ms, three threads that each
took their turn could delay a frame by half of its period."""

log = logging.getLogger(__name__)


class RealtimePriority:
    """Real-time priority of all threads of this process, and of those that they start, while
    entered.

    It is not taken with `wanted` "never", on one processor, or without permission. On one processor
    the threads are scheduled after other programs instead (see GIVE_WAY). `strain` is polled: the
    priority is given up while it returns a reason. Each change is logged.
    """

    def __init__(
        self,
        wanted: Priority = "auto",
        strain: Callable[[], str] = lambda: "",
        poll_s: float = POLL_S,
    ) -> None:
        self.held = False
        self._wanted = wanted
        self._strain = strain
        self._poll_s = poll_s
        self._left = Event()
        self._watch = Thread(target=self._watch_strain, name="priority", daemon=True)

    def __enter__(self) -> Self:
        refusal = self._refusal()
        if not refusal and not _all_threads(LOOP):
            refusal = "the system does not allow it"
        if refusal:
            log.info("ordinary priority: %s", refusal)
            if self._wanted == "auto" and processors() < MIN_PROCESSORS:
                _give_way()
            return self
        self.held = True
        log.info("real-time priority %d", LOOP)
        self._watch.start()  # it inherits the priority: it must run while others compete
        return self

    def __exit__(self, *_: object) -> None:
        self._left.set()
        if self._watch.is_alive():
            self._watch.join()
        self.give_up("the run has ended")

    def give_up(self, reason: str) -> None:
        """Schedule all threads of this process as ordinary ones."""
        if self.held:
            self.held = False
            _all_threads(ORDINARY)
            log.info("ordinary priority: %s", reason)

    def _refusal(self) -> str:
        if self._wanted == "never":
            return "--priority never"
        if processors() < MIN_PROCESSORS:
            return "on one processor it would stop the page and other programs"
        return ""

    def _watch_strain(self) -> None:
        while not self._left.wait(self._poll_s):
            reason = self._strain()
            if reason:
                self.give_up(reason)
            elif not self.held and _all_threads(LOOP):
                self.held = True
                log.info("real-time priority %d again", LOOP)


def _give_way() -> None:
    """Schedule all threads but those that answer the page's commands after ordinary programs, until
    this process ends.
    """
    if not hasattr(os, "setpriority") or not TASKS.is_dir():
        return
    # the threads that answer inherit the priority of the server's
    servers = {thread.native_id for thread in enumerate_threads() if thread.name == "view server"}
    for task in TASKS.iterdir():
        number = int(task.name)
        if number in servers:
            continue
        with suppress(OSError):  # the thread has ended since
            os.setpriority(
                os.PRIO_PROCESS, number, max(GIVE_WAY, os.getpriority(os.PRIO_PROCESS, number))
            )


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
