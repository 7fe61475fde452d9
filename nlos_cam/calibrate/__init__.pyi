__all__ = [
    "TURN_IT",
    "CaptureStatistics",
    "FrameFit",
    "WallFiles",
    "check_way_up",
    "collect_statistics",
    "fit_frame",
    "measure_by_board",
    "measure_by_depth",
    "measure_occluder",
    "write_board_pdf",
    "write_record",
]

from .board_pdf import write_board_pdf
from .files import WallFiles, write_record
from .measure import (
    TURN_IT,
    CaptureStatistics,
    FrameFit,
    check_way_up,
    collect_statistics,
    fit_frame,
    measure_by_board,
    measure_by_depth,
    measure_occluder,
)
