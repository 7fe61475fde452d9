__all__ = [
    "LOOPBACK",
    "MAX_UNCERTAINTY_M",
    "PREFERRED_PORT",
    "Moment",
    "NullViewer",
    "RecordedView",
    "RrdFile",
    "Still",
    "VideoFile",
    "Viewer",
    "Viewers",
    "WebViewer",
    "exposed",
]

from .assets import LOOPBACK
from .images import MAX_UNCERTAINTY_M
from .rrd_file import RrdFile
from .server import exposed
from .video import Still, VideoFile
from .viewer import Moment, NullViewer, Viewer, Viewers
from .web import PREFERRED_PORT, RecordedView, WebViewer
