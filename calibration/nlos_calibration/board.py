"""Printed ChArUco board on the wall: dimensions, pattern, and its corners in an image.

Board frame: origin at the pattern's upper left corner, x to the right, y down, z into the paper, as
in OpenCV.

Corners are detected once in the mean of many frames, not as the mean of many detections: the noise
falls equally, dim corners appear that no single frame shows, and sampling errors of the pixels stay
visible in the residuals, where many detections would repeat them.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nlos_calibration.arrays import Float64, Int64, UInt8
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.rig import Positive, Record

Dictionary = Literal["DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250"]
Paper = Literal["a4", "a3", "letter"]

PAPER_MM: dict[Paper, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "letter": (215.9, 279.4),
}


class Board(Record):
    """A printed ChArUco board. Measured are the chessboard corners between its markers."""

    # Only corners between four squares are measured: three squares a side leave four of them.
    squares_x: Annotated[int, Field(ge=3, le=40)]
    squares_y: Annotated[int, Field(ge=3, le=40)]
    square_mm: Positive
    """Size on paper: measure it, since printers scale."""
    marker_mm: Positive
    dictionary: Dictionary = "DICT_4X4_50"

    @model_validator(mode="after")
    def _printable(self) -> Self:
        if self.marker_mm >= self.square_mm:
            raise ValueError("a board needs marker_mm < square_mm: markers stand in white squares")
        # Markers fill the white squares, every other one.
        markers = self.squares_x * self.squares_y // 2
        known = len(self.opencv_dictionary.bytesList)
        if markers > known:
            raise ValueError(
                f"{self.squares_x} x {self.squares_y} squares need {markers} markers, there are"
                f" {known}"
            )
        return self

    @property
    def opencv_dictionary(self) -> cv2.aruco.Dictionary:
        """Marker dictionary for OpenCV."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    @property
    def opencv_board(self) -> cv2.aruco.CharucoBoard:
        """Board for OpenCV, in metres."""
        size = self.squares_x, self.squares_y
        return cv2.aruco.CharucoBoard(
            size, self.square_mm * 1e-3, self.marker_mm * 1e-3, self.opencv_dictionary
        )

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the pattern."""
        return self.squares_x * self.square_mm, self.squares_y * self.square_mm

    @property
    def corners_m(self) -> Float64:
        """Chessboard corners (n, 3) in the board frame, indexed by id."""
        return np.asarray(self.opencv_board.getChessboardCorners(), np.float64)

    def measured(self, square_mm: float) -> "Board":
        """Return the same board with squares that measure `square_mm` on paper."""
        return self.model_copy(
            update={
                "square_mm": square_mm,
                "marker_mm": self.marker_mm * square_mm / self.square_mm,
            }
        )

    def pattern(self, pixels_per_square: int) -> UInt8:
        """Return the pattern without margin (squares_y k, squares_x k), 0 is black; each square has
        k x k pixels.
        """
        size = self.squares_x * pixels_per_square, self.squares_y * pixels_per_square
        return np.asarray(self.opencv_board.generateImage(size), np.uint8)


BOARDS: dict[Paper, Board] = {
    "a4": Board(squares_x=6, squares_y=9, square_mm=30.0, marker_mm=22.5),
    "a3": Board(
        squares_x=9, squares_y=13, square_mm=30.0, marker_mm=22.5, dictionary="DICT_4X4_100"
    ),
    "letter": Board(squares_x=6, squares_y=8, square_mm=30.0, marker_mm=22.5),
}
"""Squares of 30 mm: larger ones leave too few corners in view at 0.15 m, the laser spot blurs
smaller ones.
"""


MIN_CORNERS = 8
"""With fewer corners, the residuals hardly test the pose."""
BRIGHTEST_QUANTILE = 0.9995
CONTRAST_LIMIT = 4.0
CONTRAST_TILES = (8, 8)
REMEDY = (
    "place it where the view is bright, print it with toner (dye ink is white in infrared), and"
    " lower the laser power if it is washed out"
)
"""Advice where no marker is read."""


@dataclass(frozen=True)
class Corners:
    """Chessboard corners of a board, detected in an image."""

    ids: Int64
    """(n,)."""
    pixels: Float64
    """(n, 2); x, y in pixel centres."""


def find_corners(image: NDArray[np.floating] | UInt8, board: Board) -> Corners:
    """Detect the corners of `board` in an infrared image (height, width) of any gain.

    Raises BoardRefusedError where fewer than MIN_CORNERS are found, or where the image is mirrored.
    """
    # OpenCV's own corners: refining them in a rectified image made single corners better by a
    # quarter and the plane no better.
    even = even_contrast(image)
    corners, markers = _detect(even, board)
    if len(corners.ids) >= MIN_CORNERS:
        return corners
    if len(_detect(np.ascontiguousarray(even[:, ::-1]), board)[0].ids) >= MIN_CORNERS:
        raise BoardRefusedError(
            "the board is mirrored: flip the image, or print the board without mirroring"
        )
    raise BoardRefusedError(_too_few(len(corners.ids), markers, board))


def even_contrast(image: NDArray[np.floating] | UInt8) -> UInt8:
    """Return the image (height, width) in 8 bits with its local contrast equalised (CLAHE): dim
    parts become clear.
    """
    # The laser's light falls off with distance and angle, so that the far side of an oblique board
    # is dim; contrast is equalised in tiles, in 16 bits, before it is cut to 8. A quantile sets the
    # scale, not the maximum, which may be a glint.
    brightest = float(np.quantile(image, BRIGHTEST_QUANTILE))
    fine = np.clip(image / max(brightest, 1e-9) * 65535.0, 0.0, 65535.0).astype(np.uint16)
    even = np.asarray(cv2.createCLAHE(CONTRAST_LIMIT, CONTRAST_TILES).apply(fine), np.uint16)
    return (even >> 8).astype(np.uint8)


def _detect(image: UInt8, board: Board) -> tuple[Corners, int]:
    """Return the corners and the number of markers that were read."""
    found: tuple[Any, ...] = cv2.aruco.CharucoDetector(board.opencv_board).detectBoard(image)
    pixels, ids, _, markers = found  # each may be None, which OpenCV's types omit
    count = 0 if markers is None else len(markers)
    if ids is None:
        return Corners(np.zeros(0, np.int64), np.zeros((0, 2))), count
    return (
        Corners(np.asarray(ids, np.int64).ravel(), np.asarray(pixels, np.float64).reshape(-1, 2)),
        count,
    )


def _too_few(corners: int, markers: int, board: Board) -> str:
    size = f"{board.squares_x} x {board.squares_y} squares of {board.square_mm:g} mm"
    if markers == 0:
        return f"no board of {size} is visible in infrared: {REMEDY}"
    return (
        f"{corners} corners of a board of {size} are visible ({markers} markers), {MIN_CORNERS}"
        " needed: move more of it to the near, bright side of the view, or average more frames"
    )
