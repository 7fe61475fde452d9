__all__ = [
    "CaptureStatistics",
    "FrameFit",
    "WallFiles",
    "collect_statistics",
    "files_in_bench",
    "fit_frame",
    "measure_by_board",
    "measure_by_depth",
    "measure_occluder",
    "write_board_pdf",
    "write_record",
    "write_to_bench",
]

from .board_pdf import write_board_pdf
from .files import WallFiles, files_in_bench, write_record, write_to_bench
from .measure import (
    CaptureStatistics,
    FrameFit,
    collect_statistics,
    fit_frame,
    measure_by_board,
    measure_by_depth,
    measure_occluder,
)
