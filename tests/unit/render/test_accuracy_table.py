"""Stops chosen from the table of measured errors and times."""

import numpy as np
import pytest

from nlos_cam.errors import SceneError
from nlos_cam.render import STOPS, choose
from nlos_cam.render.accuracy_table import STOP_FIGURES


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "stop"),
    [
        (0.05, None, "draft"),
        (0.01, None, "standard"),
        (0.001, None, "fine"),
        (0.0, None, "reference"),
        (None, 0.02, "standard"),
        (None, 100.0, "reference"),
        (0.05, 100.0, "draft"),
        (0.001, 0.03, "fine"),
    ],
)
def test_choose_takes_fastest_stop_within_bounds(
    max_error: float | None, max_seconds: float | None, stop: str
) -> None:
    assert choose(max_error, max_seconds).stop == stop


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "words"),
    [
        (None, 0.001, ["max_seconds 0.001", "draft", "0.0043 s"]),
        (0.0004, 0.02, ["max_error 0.0004", "max_seconds 0.02", "standard", "0.0033"]),
        (0.0, 1.0, ["max_error 0", "fine", "0.0009"]),
        (None, 0.0, ["draft"]),
    ],
)
def test_choose_out_of_bounds_names_nearest(
    max_error: float | None, max_seconds: float | None, words: list[str]
) -> None:
    with pytest.raises(SceneError) as refusal:
        choose(max_error, max_seconds)
    assert all(word in str(refusal.value) for word in words)


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "word"),
    [
        (-0.1, None, "max_error"),
        (np.nan, None, "max_error"),
        (None, -1.0, "max_seconds"),
        (None, np.inf, "max_seconds"),
        (None, None, "max_error"),
    ],
)
def test_choose_refuses_bad_or_missing_bounds(
    max_error: float | None, max_seconds: float | None, word: str
) -> None:
    with pytest.raises(SceneError, match=word):
        choose(max_error, max_seconds)


def test_table_holds_every_stop() -> None:
    assert [one.stop for one in STOP_FIGURES] == list(STOPS)


def test_slower_stops_of_the_table_err_less() -> None:
    figures = [(one.seconds, -one.error) for one in STOP_FIGURES]
    assert figures == sorted(figures)
