import gc
import os
import sys
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace

import pytest

from nlos_cam.live import RealtimePriority, low_latency_interpreter, yield_to_loop
from nlos_cam.live.realtime import (
    DRAWING,
    GIVE_WAY,
    LOOP,
    ORDINARY,
    SWITCH_S,
    TASKS,
    drop_realtime_priority,
    processors,
)

OTHER = 0
ROUND_ROBIN = 2


class System:
    """Linux's schedules by thread: `missing` has ended, and real-time priority needs `may`."""

    def __init__(self, tasks: Path, *names: str) -> None:
        self.tasks = tasks
        self.may = True
        self.missing = ""
        self.schedules = dict.fromkeys(names, (OTHER, ORDINARY))
        for name in names:
            (tasks / name).mkdir(parents=True)

    def sched_setscheduler(self, task: int, policy: int, param: int) -> None:
        if not self.may and policy:
            raise PermissionError
        if str(task) == self.missing:
            raise ProcessLookupError
        self.schedules[str(task)] = policy, param

    def sched_getscheduler(self, task: int) -> int:
        return self.schedules[str(task)][0]


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> System:
    system = System(tmp_path / "task", "0", "7", "8")
    monkeypatch.setattr("nlos_cam.live.realtime.TASKS", system.tasks)
    monkeypatch.setattr("nlos_cam.live.realtime.processors", lambda: 2)
    for name, value in (("SCHED_RR", ROUND_ROBIN), ("SCHED_OTHER", OTHER), ("sched_param", int)):
        monkeypatch.setattr(os, name, value, raising=False)
    for name in ("sched_setscheduler", "sched_getscheduler"):
        monkeypatch.setattr(os, name, getattr(system, name), raising=False)
    return system


def test_realtime_priority_holds_for_all_threads_while_entered(system: System) -> None:
    with pytest.raises(ZeroDivisionError), RealtimePriority() as priority:  # noqa: PT012  an error leaves it too
        assert priority.held
        assert set(system.schedules.values()) == {(ROUND_ROBIN, LOOP)}
        raise ZeroDivisionError
    assert set(system.schedules.values()) == {(OTHER, ORDINARY)}


def test_realtime_priority_changes_nothing_where_not_possible(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    system.missing = "7"
    with RealtimePriority() as priority:
        assert priority.held
        assert system.schedules["8"] == (ROUND_ROBIN, LOOP), "a thread that ended is passed over"
    system.may = False
    with RealtimePriority() as priority:
        assert not priority.held
    monkeypatch.setattr("nlos_cam.live.realtime.TASKS", system.tasks / "none")
    with RealtimePriority() as priority:
        assert not priority.held
    yield_to_loop()
    drop_realtime_priority()

    assert set(system.schedules.values()) == {(OTHER, ORDINARY)}


def test_realtime_priority_is_not_taken_on_one_processor(
    system: System, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr("nlos_cam.live.realtime.processors", lambda: 1)
    monkeypatch.setattr("nlos_cam.live.realtime._give_way", lambda: None)
    with RealtimePriority() as priority:
        assert not priority.held

    assert set(system.schedules.values()) == {(OTHER, ORDINARY)}
    assert "one processor" in caplog.text


@pytest.mark.usefixtures("system")
def test_run_gives_way_on_one_processor_but_not_its_view(monkeypatch: pytest.MonkeyPatch) -> None:
    nice: dict[int, int] = {0: 0, 7: 0, 8: 10}
    monkeypatch.setattr("nlos_cam.live.realtime.processors", lambda: 1)
    monkeypatch.setattr(os, "getpriority", lambda _, task: nice[task])
    monkeypatch.setattr(os, "setpriority", lambda _, task, value: nice.update({task: value}))
    view = SimpleNamespace(native_id=7, name="view server")
    monkeypatch.setattr("nlos_cam.live.realtime.enumerate_threads", lambda: [view])
    with RealtimePriority("never"):
        assert nice[0] == 0
    with RealtimePriority():
        assert nice == {0: GIVE_WAY, 7: 0, 8: 10}


def test_realtime_priority_never_is_not_taken(system: System) -> None:
    with RealtimePriority("never") as priority:
        assert not priority.held
        assert set(system.schedules.values()) == {(OTHER, ORDINARY)}


def wait_until(happened: Callable[[], bool]) -> None:
    """Poll; the test's own time limit ends a wait in vain."""
    while not happened():
        time.sleep(0.002)


def test_realtime_priority_is_given_up_while_there_is_a_reason(
    system: System, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    reason = ""
    with RealtimePriority(strain=lambda: reason, poll_s=0.001) as priority:
        reason = "a command waits"
        wait_until(lambda: not priority.held)
        assert set(system.schedules.values()) == {(OTHER, ORDINARY)}
        reason = ""
        wait_until(lambda: priority.held)
        assert set(system.schedules.values()) == {(ROUND_ROBIN, LOOP)}

    assert caplog.text.count("a command waits") == 1


def test_processors_are_those_that_this_process_may_use() -> None:
    assert 1 <= processors() <= (os.cpu_count() or 1)


def test_drawing_goes_after_the_loop_and_before_the_rest(system: System) -> None:
    yield_to_loop()

    assert system.schedules["0"] == (OTHER, ORDINARY)

    with RealtimePriority():
        yield_to_loop()
        assert system.schedules["0"] == (ROUND_ROBIN, DRAWING)
        drop_realtime_priority()
        assert system.schedules["0"] == (OTHER, ORDINARY)


@pytest.mark.skipif(not TASKS.is_dir(), reason="this system has no /proc/self/task")
def test_realtime_priority_restores_the_threads_of_this_process() -> None:
    ended = Event()
    began = Event()
    found = list[int]()

    def work() -> None:
        began.set()
        ended.wait(60.0)
        found.append(os.sched_getscheduler(0))

    before = os.sched_getscheduler(0)
    with RealtimePriority():
        worker = Thread(target=work)
        worker.start()
        assert began.wait(60.0)
    ended.set()
    worker.join(60.0)

    assert [os.sched_getscheduler(0), *found] == [before] * 2


class Loop:
    """Refers to itself: only the collector finds it."""

    def __init__(self) -> None:
        self.me = self


def test_interpreter_collects_once_and_shortens_turns_until_left() -> None:
    before_s = sys.getswitchinterval()
    earlier = weakref.ref(Loop())
    with pytest.raises(ZeroDivisionError), low_latency_interpreter():  # noqa: PT012  an error leaves it too
        assert sys.getswitchinterval() == pytest.approx(SWITCH_S, rel=0.01)
        assert earlier() is None
        known = gc.get_freeze_count()
        assert known > 1000
        later = weakref.ref(Loop())
        gc.collect()
        assert later() is None
        assert gc.get_freeze_count() == known
        raise ZeroDivisionError

    assert sys.getswitchinterval() == before_s
    assert gc.get_freeze_count() < known
