__all__ = [
    "LOOK_S",
    "BagFile",
    "CaptureResult",
    "CaptureSession",
    "CaptureTarget",
    "Exported",
    "Format",
    "Repaired",
    "ReplayCamera",
    "SdkReplayCamera",
    "Sidecar",
    "State",
    "Summary",
    "Verified",
    "Wanted",
    "export_recording",
    "load_sidecar",
    "open_lidar_bag",
    "repair_recording",
    "settle",
    "sidecar_path",
    "verify",
    "wall_of",
]

from .bag_reader import BagFile
from .capture import CaptureResult, CaptureSession, CaptureTarget, settle
from .export import Exported, Format, Wanted, export_recording
from .playback import ReplayCamera, Verified, open_lidar_bag, verify
from .repair import Repaired, repair_recording
from .sdk_playback import SdkReplayCamera
from .sidecar import LOOK_S, Sidecar, State, Summary, load_sidecar, sidecar_path, wall_of
