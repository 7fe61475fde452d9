__all__ = [
    "ACCURACY",
    "BLACK",
    "CAVEATS",
    "COLUMNS",
    "EFFECTS",
    "FORECAST_VERSION",
    "FRAMES",
    "MATERIALS",
    "SCATTER_IOU",
    "Change",
    "ChosenBeams",
    "Conditions",
    "Expectation",
    "Forecast",
    "LidarView",
    "MaterialName",
    "Prior",
    "Shape",
    "change_words",
    "changes",
    "cut",
    "fit_prior",
    "forecast",
    "hidden_words",
    "network_iou",
    "shipped_basis",
    "shipped_prior",
    "table_of",
    "words_of",
    "write_report",
]

from .advice import Change, changes
from .curve import FORECAST_VERSION, SCATTER_IOU, network_iou
from .expectation import FRAMES, Conditions, Expectation, Forecast, forecast, shipped_basis
from .lidar_view import LidarView
from .linear import ACCURACY, BLACK, EFFECTS, MATERIALS, ChosenBeams, MaterialName, cut
from .prior import Prior, Shape, fit_prior, shipped_prior
from .report import CAVEATS, COLUMNS, change_words, hidden_words, table_of, words_of, write_report
