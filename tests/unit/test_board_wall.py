import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from nlos_calibration.board import BOARDS, Light
from nlos_calibration.board_wall import BoardView, WallByBoard, wall_with_board
from nlos_calibration.errors import BoardRefusedError, WallRefusedError
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import WallFit, fit_wall

TOOLS = Path(__file__).parents[2] / "tools"
RIG = load_rig("bare-wall")
PINHOLE, A4 = RIG.pinhole, BOARDS["a4"]


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_view")


def infrared(views: ModuleType, scale: float = 1.0) -> BoardView:
    """The mean of 20 frames of a board of that scale on the wall of the rig."""
    seen = views.View(RIG.wall_from_lidar, PINHOLE)
    placed = replace(views.at_near_edge(A4, seen), scale=scale)
    frames = views.frames_of(views.clean_view(A4, seen, placed), np.random.default_rng(0), 20)
    return BoardView(frames.mean(axis=0), PINHOLE)


@pytest.fixture
def depth(views: ModuleType) -> WallFit:
    """The wall of the rig by 20 frames of depth."""
    mean = importlib.import_module("wall_scenes").looked_at(
        views.View(RIG.wall_from_lidar, PINHOLE).depth_m, np.random.default_rng(0), frames=20, noise=1.0
    )
    return fit_wall(mean.mean_m(), PINHOLE, np.random.default_rng(0), mean.noise())


def test_depth_and_board_that_agree_are_used_together(views: ModuleType, depth: WallFit) -> None:
    fit, record = wall_with_board(depth, infrared(views), A4, measured=False)
    assert isinstance(fit, WallFit)
    assert (fit.verdict, record.used, record.causes, record.depth_refused) == ("good", "both", (), "")
    assert "agree" in fit.advice
    assert (fit.distance_m, fit.facing_deg) == pytest.approx((0.2, 45.0), abs=0.02)
    assert fit.distance_std_m <= depth.distance_std_m
    assert record.disagreement_m == pytest.approx(record.distance_m - depth.distance_m)
    assert record.disagreement_sigmas is not None
    assert record.disagreement_sigmas < 4.0
    np.testing.assert_allclose(fit.wall_from_lidar[2, 3], fit.distance_m)


@pytest.mark.parametrize(("measured", "used"), [(False, "depth"), (True, "board")])
def test_a_board_printed_at_97_percent_is_noticed(views: ModuleType, depth: WallFit, measured: bool, used: str) -> None:
    fit, record = wall_with_board(depth, infrared(views, 0.97), A4, measured=measured)
    assert isinstance(fit, WallFit)
    assert (fit.verdict, record.used) == ("doubtful", used)
    assert record.disagreement_m == pytest.approx(0.2 / 0.97 - 0.2, abs=5e-4)
    assert f"the {used}'s plane is used" in fit.advice
    assert ("the print's scale: squares of" in fit.advice) is not measured
    expected_m = 0.2 / 0.97 if measured else 0.2
    assert fit.distance_m == pytest.approx(expected_m, abs=5e-4)


@pytest.mark.parametrize("light", ["infrared", "colour"])
def test_a_disagreement_in_colour_may_be_the_colour_cameras(views: ModuleType, depth: WallFit, light: Light) -> None:
    fit, record = wall_with_board(depth, replace(infrared(views, 0.97), light=light), A4, measured=False)
    assert record.seen_in == light
    for told in (fit.advice, record.causes[-1]):
        assert ("the colour camera's pose" in told) is (light == "colour")
    _, agreed = wall_with_board(depth, replace(infrared(views), light=light), A4, measured=False)
    assert (agreed.seen_in, agreed.causes) == (light, ())


def test_squares_measured_at_97_percent_bring_the_two_together(views: ModuleType, depth: WallFit) -> None:
    _, record = wall_with_board(depth, infrared(views, 0.97), A4.measured(29.1), measured=True)
    assert record.used == "both"
    assert record.printed.square_mm == 29.1


def test_where_depth_is_refused_the_board_is_used_and_doubted(views: ModuleType) -> None:
    refusal = WallRefusedError("the wall is not flat: take another")
    fit, record = wall_with_board(refusal, infrared(views), A4, measured=False)
    assert isinstance(fit, WallByBoard)
    assert (fit.verdict, record.used, record.depth_refused) == ("doubtful", "board", str(refusal))
    assert str(refusal) in fit.advice
    assert record.disagreement_m is record.disagreement_deg is record.disagreement_sigmas is None
    assert fit.distance_m == pytest.approx(0.2, abs=3.0 * fit.distance_std_m)
    assert fit.distance_m == record.distance_m
    np.testing.assert_allclose(fit.wall_from_lidar, RIG.wall_from_lidar, atol=3e-3)


def test_a_doubt_of_the_depths_stays(views: ModuleType, depth: WallFit) -> None:
    doubted = replace(depth, verdict="doubtful", advice="half of the view differs")
    fit, _ = wall_with_board(doubted, infrared(views), A4, measured=False)
    assert (fit.verdict, fit.advice) == ("doubtful", "half of the view differs")


def test_a_wall_out_of_range_is_so_by_both(views: ModuleType) -> None:
    """The pinhole of another lidar, as it were: all the same, but twice as far away."""
    refusal = WallRefusedError("none")
    fit, _ = wall_with_board(refusal, infrared(views), A4.measured(60.0), measured=True)
    assert fit.distance_m == pytest.approx(0.4, abs=0.005)
    assert "move the lidar 10 cm closer" in fit.advice


def test_without_a_board_there_is_a_refusal(depth: WallFit) -> None:
    with pytest.raises(BoardRefusedError, match="no board"):
        wall_with_board(depth, BoardView(np.full((480, 640), 40.0), PINHOLE), A4, measured=False)
