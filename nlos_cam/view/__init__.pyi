__all__ = [
    "LOOPBACK",
    "MAX_UNCERTAINTY_M",
    "PREFERRED_PORT",
    "SESSION_SUFFIX",
    "Assessment",
    "Controls",
    "Moment",
    "NullViewer",
    "PlaybackViewer",
    "RecordedView",
    "SessionFile",
    "Still",
    "VideoFile",
    "Viewer",
    "Viewers",
    "WebViewer",
    "assess",
    "exposed",
]

from .assessment import Assessment, assess
from .images import MAX_UNCERTAINTY_M
from .server import LOOPBACK, exposed
from .session_file import SESSION_SUFFIX, SessionFile
from .video import Still, VideoFile
from .viewer import Controls, Moment, NullViewer, Viewer, Viewers
from .web import PREFERRED_PORT, PlaybackViewer, RecordedView, WebViewer
