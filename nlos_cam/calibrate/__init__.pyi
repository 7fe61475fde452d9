__all__ = [
    "CaptureStatistics",
    "FrameFit",
    "View",
    "WallFiles",
    "bent",
    "capture_color_view",
    "collect_statistics",
    "curved",
    "depth_statistics",
    "fit_frame",
    "measure_by_board",
    "measure_by_depth",
    "measure_occluder",
    "patch",
    "patchy",
    "rippled",
    "stepped",
    "view",
    "window",
    "with_outliers",
    "write_board_pdf",
    "write_record",
]

from .board_pdf import write_board_pdf
from .color_view import capture_color_view
from .files import WallFiles, write_record
from .measure import (
    CaptureStatistics,
    FrameFit,
    collect_statistics,
    fit_frame,
    measure_by_board,
    measure_by_depth,
    measure_occluder,
)
from .synthetic import (
    View,
    bent,
    curved,
    depth_statistics,
    patch,
    patchy,
    rippled,
    stepped,
    view,
    window,
    with_outliers,
)
