__all__ = [
    "SAMPLE",
    "BagReader",
    "CaptureResult",
    "CaptureSession",
    "CaptureTarget",
    "ExportOptions",
    "ExportResult",
    "Format",
    "QualityMeter",
    "RepairResult",
    "ReplayCamera",
    "Sidecar",
    "SidecarFile",
    "Summary",
    "TakeState",
    "Telemetry",
    "VerifyResult",
    "export_recording",
    "finalize",
    "load_measured_wall",
    "load_sidecar",
    "no_frames",
    "open_lidar_bag",
    "repair_recording",
    "sidecar_path",
    "verify",
    "with_telemetry",
]

from .bag_reader import SAMPLE, BagReader, no_frames
from .capture import CaptureResult, CaptureSession, CaptureTarget, finalize
from .export import ExportOptions, ExportResult, Format, export_recording
from .playback import ReplayCamera, VerifyResult, open_lidar_bag, verify
from .quality import QualityMeter
from .repair import RepairResult, repair_recording
from .sidecar import (
    Sidecar,
    SidecarFile,
    Summary,
    TakeState,
    load_measured_wall,
    load_sidecar,
    sidecar_path,
)
from .telemetry import Telemetry, with_telemetry
