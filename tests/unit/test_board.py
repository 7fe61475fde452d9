import cv2
import numpy as np
import pytest
from nlos_calibration.board import BOARDS, PAPER_MM, Board, Paper
from nlos_calibration.rig import dump_toml
from pydantic import ValidationError

SMALL = {"squares_x": 4, "squares_y": 5, "square_mm": 20.0, "marker_mm": 15.0}


@pytest.mark.parametrize("paper", BOARDS)
def test_a_default_board_leaves_room_on_its_paper(paper: Paper) -> None:
    """5 mm that no printer reaches at the sides, and 20 mm below for the bar and its text."""
    (width_mm, height_mm), (across_mm, down_mm) = PAPER_MM[paper], BOARDS[paper].size_mm
    assert across_mm <= width_mm - 10.0
    assert down_mm <= height_mm - 25.0


@pytest.mark.parametrize("paper", BOARDS)
def test_every_corner_of_the_pattern_is_detected_where_it_is_said_to_be(paper: Paper) -> None:
    board, k = BOARDS[paper], 64
    pattern = np.pad(board.pattern(k), k, constant_values=255)
    pixels, ids, _, markers = cv2.aruco.CharucoDetector(board.opencv_board).detectBoard(pattern)
    assert len(markers) == board.squares_x * board.squares_y // 2
    assert sorted(ids.ravel()) == list(range((board.squares_x - 1) * (board.squares_y - 1)))
    per_m = k / (board.square_mm * 1e-3)
    expected = board.corners_m[ids.ravel(), :2] * per_m + k - 0.5
    np.testing.assert_allclose(pixels, expected, atol=0.1)


def test_corners_are_a_grid_one_square_apart_and_inside_the_pattern() -> None:
    board = Board(**SMALL)
    grid = [(x * 0.02, y * 0.02, 0.0) for y in range(1, 5) for x in range(1, 4)]
    np.testing.assert_allclose(board.corners_m, grid, atol=1e-8)


def test_a_measured_board_is_the_same_one_scaled() -> None:
    board = BOARDS["a4"].measured(29.1)
    np.testing.assert_allclose(board.corners_m, 0.97 * BOARDS["a4"].corners_m, atol=1e-8)
    assert board.marker_mm / board.square_mm == pytest.approx(0.75)
    np.testing.assert_array_equal(board.pattern(32), BOARDS["a4"].pattern(32))


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"marker_mm": 20.0}, "marker_mm < square_mm"),
        ({"squares_x": 11, "squares_y": 11}, "need 60 markers, there are 50"),
        ({"squares_x": 2}, "squares_x"),
        ({"square_mm": float("nan")}, "square_mm"),
        ({"dictionary": "DICT_7X7_50"}, "dictionary"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_board_that_cannot_be_is_refused(changed: dict[str, object], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        Board.model_validate(SMALL | changed)


def test_a_board_survives_a_file() -> None:
    import tomllib

    assert Board.model_validate(tomllib.loads(dump_toml(BOARDS["a3"]))) == BOARDS["a3"]
