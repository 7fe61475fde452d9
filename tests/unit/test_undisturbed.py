import gc
import sys
import weakref

import pytest

from nlos_cam.live.realtime import SWITCH_S, undisturbed


class Loop:
    """Refers to itself: only the collector finds it."""

    def __init__(self) -> None:
        self.me = self


def test_what_is_alive_is_not_looked_through_and_what_comes_later_is_collected() -> None:
    with undisturbed():
        assert gc.get_freeze_count() > 1000
        known = gc.get_freeze_count()
        garbage = weakref.ref(Loop())
        gc.collect()
        assert garbage() is None
        assert gc.get_freeze_count() == known
    assert gc.get_freeze_count() < known


def test_garbage_from_before_is_collected_and_not_kept() -> None:
    garbage = weakref.ref(Loop())
    with undisturbed():
        assert garbage() is None


def test_turns_are_short_meanwhile_and_as_before_afterwards_also_after_an_error() -> None:
    before_s, within_s = sys.getswitchinterval(), 0.0

    def fail() -> None:
        nonlocal within_s
        with undisturbed():
            within_s = sys.getswitchinterval()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert within_s == pytest.approx(SWITCH_S, rel=0.01)
    assert sys.getswitchinterval() == before_s
