__all__ = [
    "OBJECT_FORMATS",
    "REPORT",
    "VIDEO",
    "Playback",
    "ReplayMedia",
    "export_objects",
    "replay_recording",
]

from .media import VIDEO, ReplayMedia
from .object_files import OBJECT_FORMATS, export_objects
from .playback import Playback
from .replay import REPORT, replay_recording
