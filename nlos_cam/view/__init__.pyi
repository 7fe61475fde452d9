__all__ = [
    "LOOPBACK",
    "MAX_UNCERTAINTY_M",
    "PREFERRED_PORT",
    "SESSION_MARK",
    "SESSION_SUFFIX",
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
    "WrittenFiles",
    "dated_file",
    "element",
    "exposed",
    "prepare_saving",
    "save_moment",
    "unpack",
]

from .frame_files import WrittenFiles, dated_file, prepare_saving, save_moment
from .images import MAX_UNCERTAINTY_M
from .messages import unpack
from .server import LOOPBACK, exposed
from .session_file import SessionFile, element
from .session_mark import SESSION_MARK, SESSION_SUFFIX
from .video import Still, VideoFile
from .viewer import Moment, NullViewer, Viewer, Viewers
from .web import PREFERRED_PORT, PlaybackViewer, RecordedView, WebViewer
