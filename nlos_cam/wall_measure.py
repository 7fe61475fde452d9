"""From what was seen of a bare wall to its fit, by depth, tape and printed board, and what the record says of it."""

import numpy as np
from nlos_calibration.board import Board
from nlos_calibration.board_view import BoardView
from nlos_calibration.board_wall import WallByBoard, wall_with_board
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.range_offset import tape_the_wall
from nlos_calibration.wall import WallFit, fit_wall

from nlos_cam.wall_look import Seen


def by_depth(seen: Seen, tape_m: float | None = None) -> tuple[WallFit, dict[str, object]]:
    """The wall by its depth, and what the record says of the lidar's offset where a distance was measured by hand.

    Raises WallRefusedError, and CalibrationError where tape and lidar cannot both be right.
    """
    depth_m, noise = seen.statistics.depth.mean_m(), seen.statistics.depth.noise()

    def fit_with(offset_m: float, origin_m: float) -> WallFit:
        return fit_wall(depth_m + offset_m, seen.intrinsics, np.random.default_rng(0), noise, origin_m)

    if tape_m is None:
        return fit_with(0.0, 0.0), {}
    taped = tape_the_wall(fit_with, tape_m)
    return taped.fit, {
        "range_offset_m": taped.offset_m,
        "range_offset_std_m": taped.offset_std_m,
        "range_offset_cause": taped.cause,
    }


def by_board(
    seen: Seen, printed: Board, square_mm: float | None, colour: BoardView | None = None
) -> tuple[WallFit | WallByBoard, dict[str, object]]:
    """The wall by its depth, where that is not refused, and by a board, with what the record says of that.

    The board is looked for in the mean infrared, unless there is a `colour` view of it. Raises BoardRefusedError.
    """
    try:
        depth = by_depth(seen)[0]
    except WallRefusedError as error:
        depth = error
    measured = square_mm is not None
    board = printed.measured(square_mm) if measured else printed
    view = colour or BoardView(seen.statistics.ir_mean(), seen.intrinsics)
    fit, record = wall_with_board(depth, view, board, measured=measured)
    return fit, {"board": record}
