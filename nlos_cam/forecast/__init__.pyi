__all__ = [
    "CAVEATS",
    "COLUMNS",
    "FRAMES",
    "MATERIALS",
    "Change",
    "Conditions",
    "Expectation",
    "Forecast",
    "MaterialName",
    "Prior",
    "Shape",
    "change_words",
    "changes",
    "fit_prior",
    "forecast",
    "hidden_words",
    "network_iou",
    "shipped_prior",
    "table_of",
    "words_of",
    "write_report",
]

from .advice import Change, changes
from .curve import network_iou
from .expectation import FRAMES, Conditions, Expectation, Forecast, forecast
from .linear import MATERIALS, MaterialName
from .prior import Prior, Shape, fit_prior, shipped_prior
from .report import CAVEATS, COLUMNS, change_words, hidden_words, table_of, words_of, write_report
