import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from nlos_calibration.board import BOARDS, PAPER_MM, Board, Paper
from numpy.typing import NDArray

from nlos_cam.calibrate.board_pdf import (
    BAR_MM,
    bar_mm,
    black_cells,
    board_figure,
    pattern_origin_mm,
    write_board_pdf,
)

DPI = 254
PIXELS_PER_MM = DPI / 25.4


@pytest.fixture(params=list(BOARDS))
def paper(request: pytest.FixtureRequest) -> Paper:
    return request.param


@pytest.fixture
def dots(paper: Paper) -> NDArray[np.uint8]:
    """The sheet as printed, at ten dots per millimetre; 0 is black."""
    figure = board_figure(paper)
    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., 0].copy()


def test_sheet_shows_the_board_to_scale(paper: Paper, dots: NDArray[np.uint8]) -> None:
    board = BOARDS[paper]
    pixels, ids, _, markers = cv2.aruco.CharucoDetector(board.opencv_board).detectBoard(dots)

    assert len(markers) == board.squares_x * board.squares_y // 2
    assert len(ids) == len(board.corners_m)

    corners_mm = board.corners_m[ids.ravel(), :2] * 1e3 + pattern_origin_mm(paper)
    expected = corners_mm * PIXELS_PER_MM - 0.5

    np.testing.assert_allclose(pixels, expected, atol=0.6)  # 0.06 mm


def test_bar_on_the_sheet_is_100_mm_long(paper: Paper, dots: NDArray[np.uint8]) -> None:
    (_, top_mm, _, height_mm), *_ = bar_mm(paper)
    row = dots[int((top_mm + height_mm / 2.0) * PIXELS_PER_MM)]
    black = np.flatnonzero(row < 128)

    assert len(black) == black[-1] - black[0] + 1
    assert len(black) / PIXELS_PER_MM == pytest.approx(BAR_MM, abs=0.15)


def test_sheet_has_a_white_margin(dots: NDArray[np.uint8]) -> None:
    edge = int(5.0 * PIXELS_PER_MM)
    dots[edge:-edge, edge:-edge] = 255

    assert (dots == 255).all()


def test_sheet_is_white_below_the_pattern(paper: Paper, dots: NDArray[np.uint8]) -> None:
    bottom_mm = pattern_origin_mm(paper)[1] + BOARDS[paper].size_mm[1]
    bottom = int(bottom_mm * PIXELS_PER_MM) + 1

    assert (dots[bottom : bottom + int(2.0 * PIXELS_PER_MM)] == 255).all()


def test_black_cells_are_those_that_opencv_draws() -> None:
    board = Board(squares_x=4, squares_y=5, square_mm=24.0, marker_mm=18.0)
    k = 48
    drawn = np.full((5 * k, 4 * k), 255, np.uint8)
    for left, top, width, height in black_cells(board, 0.0, 0.0):
        rows = slice(round(2 * top), round(2 * (top + height)))
        columns = slice(round(2 * left), round(2 * (left + width)))
        drawn[rows, columns] = 0

    np.testing.assert_array_equal(drawn, board.pattern(k))


def test_write_sheet_makes_a_vector_page_of_the_paper(tmp_path: Path, paper: Paper) -> None:
    write_board_pdf(tmp_path / "board.pdf", paper)
    content = (tmp_path / "board.pdf").read_bytes()

    assert content.startswith(b"%PDF-")

    (box,) = re.findall(rb"/MediaBox \[([^\]]*)\]", content)
    points = [0.0, 0.0, *(72.0 * mm / 25.4 for mm in PAPER_MM[paper])]

    assert [float(number) for number in box.split()] == pytest.approx(points, abs=0.01)
    assert b"/Subtype /Image" not in content
