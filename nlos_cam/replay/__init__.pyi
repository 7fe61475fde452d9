__all__ = [
    "OBJECT_FORMATS",
    "REPORT",
    "RESULT",
    "VIDEO",
    "Playback",
    "ReplayMedia",
    "export_objects",
    "replay_recording",
]

from .media import VIDEO, ReplayMedia
from .object_files import OBJECT_FORMATS, export_objects
from .playback import Playback
from .replay import REPORT, RESULT, replay_recording
