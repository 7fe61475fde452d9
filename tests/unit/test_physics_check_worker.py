import os
import pickle
from io import BytesIO
from threading import Event
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.frames import LidarMaps
from nlos_cam.live.physics_check_process import main, serve
from nlos_cam.reconstruct.physics_check import check

RIG = load_rig("bare-wall")
NOTHING = np.full((64, 64), np.nan, np.float32)
DARK = LidarMaps(np.full((64, 80), np.nan, np.float32), np.zeros((64, 80), np.float32), np.zeros((64, 80), np.bool_))


def answers(*frames: object, end: bytes = b"") -> list[Any]:
    left = Event()
    asked = BytesIO(b"".join(pickle.dumps(each) for each in ((RIG, "draft"), *frames)) + end)
    told = BytesIO()
    serve(asked, told, left.set)
    assert left.wait(10.0)
    told.seek(0)
    found = list[Any]()
    while told.tell() < len(told.getvalue()):
        found.append(pickle.load(told))  # noqa: S301  what we wrote ourselves
    return found


def test_each_frame_is_answered_in_order_as_if_checked_here() -> None:
    found = answers((4, DARK, NOTHING), (9, DARK, NOTHING))
    assert [each.frame_number for each in found] == [4, 9]
    assert found[0].score == check(DARK, NOTHING, RIG, accuracy="draft").score


def test_a_frame_that_cannot_be_checked_is_told_in_words_and_the_next_is_checked() -> None:
    said, found = answers((1, "no maps", NOTHING), (2, DARK, NOTHING))
    assert said.startswith("AttributeError: ")
    assert found.frame_number == 2


@pytest.mark.parametrize("end", [b"", pickle.dumps((3, DARK, NOTHING))[:-9], b"not a pickle"])
def test_it_leaves_where_its_parent_went_away_or_broke_off(end: bytes) -> None:
    assert len(answers((1, DARK, NOTHING), end=end)) == 1


def test_it_works_with_the_least_urgency_and_what_is_printed_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    niced, served = [], []
    monkeypatch.setattr(os, "nice", niced.append, raising=False)

    class Pipe:
        def __init__(self, name: str) -> None:
            self.buffer = name

    import sys

    stderr = Pipe("stderr")
    for name, pipe in (("stdin", Pipe("asked")), ("stdout", Pipe("told")), ("stderr", stderr)):
        monkeypatch.setattr(sys, name, pipe)
    monkeypatch.setattr(
        "nlos_cam.live.physics_check_process.serve",
        lambda asked, told, leave: served.append((asked, told, sys.stdout is stderr, callable(leave))),
    )
    main()
    assert niced == [19]
    assert served == [("asked", "told", True, True)]
