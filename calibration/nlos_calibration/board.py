"""The ChArUco board that is printed and put on the wall: its measures, its pattern, its corners.

Board frame: origin at the pattern's upper left corner, x to the right, y down, z into the paper, as OpenCV has it.
"""

from typing import Annotated, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nlos_calibration.arrays import Float64
from nlos_calibration.rig import Positive, Record

Dictionary = Literal["DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250"]
Paper = Literal["a4", "a3", "letter"]

PAPER_MM: dict[Paper, tuple[float, float]] = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}


class Board(Record):
    """A printed ChArUco board. What lies between its markers are chessboard corners, which is what is measured."""

    squares_x: Annotated[int, Field(ge=3, le=40)]
    squares_y: Annotated[int, Field(ge=3, le=40)]
    square_mm: Positive
    """As printed: measure it, printers scale."""
    marker_mm: Positive
    dictionary: Dictionary = "DICT_4X4_50"

    @model_validator(mode="after")
    def _printable(self) -> Self:
        if self.marker_mm >= self.square_mm:
            raise ValueError("a board needs marker_mm < square_mm: markers stand in white squares")
        markers, known = self.squares_x * self.squares_y // 2, len(self.opencv_dictionary.bytesList)
        if markers > known:
            raise ValueError(f"{self.squares_x} x {self.squares_y} squares need {markers} markers, there are {known}")
        return self

    @property
    def opencv_dictionary(self) -> cv2.aruco.Dictionary:
        """The markers."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    @property
    def opencv_board(self) -> cv2.aruco.CharucoBoard:
        """The same for OpenCV, in metres."""
        size = self.squares_x, self.squares_y
        return cv2.aruco.CharucoBoard(size, self.square_mm * 1e-3, self.marker_mm * 1e-3, self.opencv_dictionary)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the pattern."""
        return self.squares_x * self.square_mm, self.squares_y * self.square_mm

    @property
    def corners_m(self) -> Float64:
        """The chessboard corners (n, 3) in the board frame, by their ids."""
        return np.asarray(self.opencv_board.getChessboardCorners(), np.float64)

    def measured(self, square_mm: float) -> "Board":
        """The same board where a print's squares turned out to measure `square_mm`."""
        return self.model_copy(
            update={"square_mm": square_mm, "marker_mm": self.marker_mm * square_mm / self.square_mm}
        )

    def pattern(self, pixels_per_square: int) -> NDArray[np.uint8]:
        """The pattern without a margin (squares_y k, squares_x k), 0 is black; each square has k x k pixels."""
        size = self.squares_x * pixels_per_square, self.squares_y * pixels_per_square
        return np.asarray(self.opencv_board.generateImage(size), np.uint8)


BOARDS: dict[Paper, Board] = {
    "a4": Board(squares_x=6, squares_y=9, square_mm=30.0, marker_mm=22.5),
    "a3": Board(squares_x=9, squares_y=13, square_mm=30.0, marker_mm=22.5, dictionary="DICT_4X4_100"),
    "letter": Board(squares_x=6, squares_y=8, square_mm=30.0, marker_mm=22.5),
}
"""Squares of 30 mm: larger ones leave too few corners in view at 0.15 m, smaller ones drown in the laser's spot."""
