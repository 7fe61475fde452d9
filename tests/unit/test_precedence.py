"""Precedence is asked of the system for every thread, and given back."""

import os
from pathlib import Path
from threading import Event, Thread

import pytest

from nlos_cam.live import realtime as module
from nlos_cam.live.realtime import DRAWING, LOOP, ORDINARY, after_the_loop, as_any_other, precedence

OTHER, ROUND_ROBIN = 0, 2


class System:
    """Schedules by thread, as Linux keeps them; `missing` ended, and no more than `may` is allowed."""

    def __init__(self, tasks: Path, *names: str, may: bool = True) -> None:
        self.tasks, self.may, self.missing = tasks, may, ""
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
    monkeypatch.setattr(module, "TASKS", system.tasks)
    for name, value in (("SCHED_RR", ROUND_ROBIN), ("SCHED_OTHER", OTHER), ("sched_param", int)):
        monkeypatch.setattr(os, name, value, raising=False)
    for name in ("sched_setscheduler", "sched_getscheduler"):
        monkeypatch.setattr(os, name, getattr(system, name), raising=False)
    return system


def test_all_threads_go_before_ordinary_ones_meanwhile_also_after_an_error(system: System) -> None:
    def fail() -> None:
        with precedence() as allowed:
            assert allowed
            assert set(system.schedules.values()) == {(ROUND_ROBIN, LOOP)}
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert set(system.schedules.values()) == {(OTHER, ORDINARY)}


def test_where_it_is_not_allowed_nothing_changes(system: System) -> None:
    system.may = False
    with precedence() as allowed:
        assert not allowed
        assert set(system.schedules.values()) == {(OTHER, ORDINARY)}


def test_a_thread_that_ends_meanwhile_is_passed_over(system: System) -> None:
    system.missing = "7"
    with precedence() as allowed:
        assert allowed
        assert system.schedules["8"] == (ROUND_ROBIN, LOOP)


def test_drawing_goes_after_the_loop_and_before_all_else(system: System) -> None:
    after_the_loop()
    assert system.schedules["0"] == (OTHER, ORDINARY)
    with precedence():
        after_the_loop()
        assert system.schedules["0"] == (ROUND_ROBIN, DRAWING)
        as_any_other()
        assert system.schedules["0"] == (OTHER, ORDINARY)


def test_a_system_without_schedules_is_left_alone(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TASKS", system.tasks / "none")
    with precedence() as allowed:
        assert not allowed
    after_the_loop()
    as_any_other()
    assert set(system.schedules.values()) == {(OTHER, ORDINARY)}


@pytest.mark.skipif(not module.TASKS.is_dir(), reason="this system has no /proc/self/task")
def test_threads_here_are_as_before_afterwards() -> None:
    ended, begun, found = Event(), Event(), list[int]()

    def work() -> None:
        begun.set()
        ended.wait(10.0)
        found.append(os.sched_getscheduler(0))

    before = os.sched_getscheduler(0)
    with precedence():
        worker = Thread(target=work)
        worker.start()
        assert begun.wait(10.0)
    ended.set()
    worker.join(10.0)
    assert [os.sched_getscheduler(0), *found] == [before] * 2
