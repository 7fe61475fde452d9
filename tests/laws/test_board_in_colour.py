"""What a board seen by another camera must tell: the wall of the lidar, as surely as it is calibrated."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest
from nlos_calibration.board_view import EXACT, CameraErrors

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture
def colour(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_in_colour")


@pytest.mark.parametrize(
    "errors",
    [CameraErrors(), EXACT, CameraErrors(0.0, 0.0, 0.003), CameraErrors(1.0, 0.0, 0.0), CameraErrors(0.0, 0.005, 0.0)],
    ids=["all", "none", "focal length", "turn", "shift"],
)
def test_the_truth_is_in_the_interval_as_often_as_it_should_be(colour: ModuleType, errors: CameraErrors) -> None:
    """Of each error by itself it would not be, if that one were left out of what is told."""
    told = colour.coverage(300, 0.05, 7, errors)
    assert told["refused"] <= 3
    for share in told["in_95_percent_interval"].values():
        assert 0.91 < share < 0.985


def test_rendered_boards_are_as_sure_as_they_say(colour: ModuleType) -> None:
    """30 benches, three figures of each: pooled, a share of 95 % is found above 87 % but for once in 1000."""
    told = colour.coverage(30, None, 8)
    assert told["refused"] <= 1
    assert told["in_95_percent_interval_pooled"] > 0.87
    assert told["p95"]["distance_mm"] < 3.0
