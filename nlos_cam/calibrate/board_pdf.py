"""Printable ChArUco board of `nlos-cam board`: the pattern to exact scale, a scale bar, and
printing advice.
"""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from nlos_calibration import BOARDS, PAPER_MM, Board, Paper

from nlos_cam.files import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch

MM_PER_INCH = 25.4
BAR_MM = 100.0
TOP_MM = 7.0
"""White above the pattern. Printers leave a margin of 4 to 5 mm."""
BAR_ABOVE_EDGE_MM = 15.0
TEXT_ABOVE_EDGE_MM = 5.5
TICK_MM = 2.0
BAR_WIDTH_MM = 0.35
TEXT_POINTS = 6.0

Rectangle = tuple[float, float, float, float]
"""Left, top, width, height in mm from the sheet's upper left corner."""


def board_figure(paper: Paper) -> "Figure":
    """Return the sheet as a figure of the paper's size; coordinates are millimetres from its upper
    left corner.
    """
    from matplotlib.figure import Figure

    board = BOARDS[paper]
    width_mm, height_mm = PAPER_MM[paper]
    figure = Figure(figsize=(width_mm / MM_PER_INCH, height_mm / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width_mm), ylim=(height_mm, 0.0))
    axes.axis("off")
    # one path for all cells: separate ones would show hairlines where they meet
    axes.add_patch(_patch(list(black_cells(board, *pattern_origin_mm(paper)))))
    axes.add_patch(_patch(bar_mm(paper)))
    text_mm = width_mm / 2.0, height_mm - TEXT_ABOVE_EDGE_MM
    axes.text(*text_mm, _text(board, paper), size=TEXT_POINTS, ha="center", va="bottom")
    return figure


def write_board_pdf(path: Path, paper: Paper) -> None:
    """Write the sheet as a PDF page of the paper's size."""
    page = BytesIO()
    board_figure(paper).savefig(page, format="pdf", metadata={"Title": f"nlos-cam board, {paper}"})
    with atomic_file(path) as part:
        part.write_bytes(page.getvalue())


def pattern_origin_mm(paper: Paper) -> tuple[float, float]:
    """Return the pattern's upper left corner (x, y) in mm."""
    return (PAPER_MM[paper][0] - BOARDS[paper].size_mm[0]) / 2.0, TOP_MM


def bar_mm(paper: Paper) -> list[Rectangle]:
    """Return the scale bar and its ticks: 100 mm between the ticks' outer edges."""
    width_mm, height_mm = PAPER_MM[paper]
    left_mm = (width_mm - BAR_MM) / 2.0
    line_mm = height_mm - BAR_ABOVE_EDGE_MM
    tick_mm = line_mm - TICK_MM / 2.0
    return [
        (left_mm, line_mm - BAR_WIDTH_MM / 2.0, BAR_MM, BAR_WIDTH_MM),
        (left_mm, tick_mm, BAR_WIDTH_MM, TICK_MM),
        (left_mm + BAR_MM - BAR_WIDTH_MM, tick_mm, BAR_WIDTH_MM, TICK_MM),
    ]


def black_cells(board: Board, left_mm: float, top_mm: float) -> Iterator[Rectangle]:
    """Yield the black squares and marker cells of a pattern whose upper left corner is at (left_mm,
    top_mm).
    """
    side_mm = board.square_mm
    for row in range(board.squares_y):
        for column in range(row % 2, board.squares_x, 2):
            yield left_mm + column * side_mm, top_mm + row * side_mm, side_mm, side_mm

    dictionary = board.opencv_dictionary
    drawn = board.opencv_board
    # one pixel for each cell, and one more on either side for the marker's black border
    size = dictionary.markerSize + 2
    cell_mm = board.marker_mm / size
    for marker, corners_m in zip(drawn.getIds(), drawn.getObjPoints(), strict=True):
        cells = np.asarray(cv2.aruco.generateImageMarker(dictionary, int(marker), size))
        x_mm, y_mm = np.asarray(corners_m)[0, :2] * 1e3
        for row, column in np.argwhere(cells == 0):
            left = left_mm + float(x_mm) + column * cell_mm
            top = top_mm + float(y_mm) + row * cell_mm
            yield left, top, cell_mm, cell_mm


def _patch(rectangles: list[Rectangle]) -> "PathPatch":
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    outlines = [
        Outline([(x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y)], closed=True)
        for x, y, w, h in rectangles
    ]
    return PathPatch(
        Outline.make_compound_path(*outlines), facecolor="black", edgecolor="none", linewidth=0.0
    )


def _text(board: Board, paper: Paper) -> str:
    squares = (
        f"{board.squares_x} x {board.squares_y} squares of {board.square_mm:g} mm,"
        f" {board.dictionary}"
    )
    return (
        "Print at 100 % (not “fit to page”): this bar must measure 100 mm. If it measures B mm,"
        f" give --square-mm {board.square_mm / BAR_MM:g} x B.\nUse a laser printer: toner is black"
        " in infrared, dye ink is white. Glue the sheet flat on the near side of the"
        f" wall.\nnlos-cam board, {paper}: {squares}"
    )
