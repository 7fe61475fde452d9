__all__ = [
    "CAPTURES",
    "Capture",
    "CaptureKind",
    "Layout",
    "Noise",
    "Transient",
    "Volume",
    "back_projection",
    "load_transient",
    "peak_m",
    "render_transient",
    "save_transient",
    "transient_document",
    "transient_figure",
]

from .back_projection import Volume, back_projection, peak_m
from .picture import transient_document, transient_figure
from .rendered import CAPTURES, Capture, CaptureKind, Noise, render_transient
from .tal_file import load_transient, save_transient
from .transient import Layout, Transient
