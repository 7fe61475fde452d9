__all__ = [
    "FRAMES",
    "Change",
    "Conditions",
    "Expectation",
    "Forecast",
    "Prior",
    "Shape",
    "changes",
    "fit_prior",
    "forecast",
    "network_iou",
    "shipped_prior",
    "write_report",
]

from .changes import Change, changes
from .curve import network_iou
from .forecast import FRAMES, Conditions, Expectation, Forecast, forecast
from .prior import Prior, Shape, fit_prior, shipped_prior
from .report import write_report
