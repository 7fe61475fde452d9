__all__ = [
    "FRAME_GLOB",
    "FRAME_STEM",
    "SAMPLE",
    "BagReader",
    "CaptureResult",
    "CaptureSession",
    "CaptureTarget",
    "ExportOptions",
    "ExportResult",
    "Format",
    "FrameNames",
    "QualityMeter",
    "RepairResult",
    "ReplayCamera",
    "RosOptions",
    "RosReader",
    "Sidecar",
    "SidecarFile",
    "Summary",
    "TakeState",
    "Telemetry",
    "VerifyResult",
    "WallFile",
    "export_recording",
    "export_ros2",
    "finalize",
    "is_ros2",
    "load_measured_wall",
    "load_sidecar",
    "open_lidar_bag",
    "open_recording",
    "recorded_wall",
    "repair_recording",
    "require_frames",
    "sidecar_path",
    "verify",
    "with_telemetry",
]

from .bag_reader import SAMPLE, BagReader
from .capture import CaptureResult, CaptureSession, CaptureTarget, finalize
from .export import ExportOptions, ExportResult, Format, export_recording, require_frames
from .formats import is_ros2, open_recording
from .frame_names import FRAME_GLOB, FRAME_STEM, FrameNames
from .playback import ReplayCamera, VerifyResult, open_lidar_bag, verify
from .quality import QualityMeter
from .repair import RepairResult, repair_recording
from .ros_reader import RosReader
from .ros_writer import RosOptions, export_ros2
from .sidecar import (
    Sidecar,
    SidecarFile,
    Summary,
    TakeState,
    WallFile,
    load_measured_wall,
    load_sidecar,
    recorded_wall,
    sidecar_path,
)
from .telemetry import Telemetry, with_telemetry
