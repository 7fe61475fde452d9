__all__ = [
    "FORMATS",
    "FRAMES_PER_S",
    "MAC_WHEEL",
    "NAMES",
    "OPTIONAL",
    "PLAIN_NAMES",
    "QUEUED_SETS",
    "RESERVE_BYTES",
    "SAME_INSTANT_S",
    "SIDECAR_SUFFIX",
    "SIMULATED",
    "SIMULATED_SERIAL",
    "WHEEL",
    "WORLDS",
    "WRAP_PERIOD_S",
    "Camera",
    "ClockUnwrap",
    "DeviceInfo",
    "FrameSet",
    "FrameSynchronizer",
    "OnProgress",
    "Recording",
    "Sample",
    "SimulatedCamera",
    "SoftwareLidar",
    "WallClock",
    "World",
    "camera_to_name",
    "check_room",
    "connected",
    "find_l515",
    "find_streams",
    "frame_in_si",
    "free_bytes",
    "full_uri",
    "gravity_of",
    "intrinsics_of",
    "load_sdk",
    "open_camera",
    "open_world",
    "pack_loop",
    "read_packaged",
    "recording_s",
    "render_loop",
    "repair_command",
    "sample_from_sdk",
    "sdk_serial",
    "shared_context",
    "stream_name",
]

from .accelerometer import gravity_of
from .l515 import DeviceInfo, connected, find_l515, shared_context
from .protocol import SIMULATED_SERIAL, Camera, OnProgress, WallClock
from .recorder import (
    RESERVE_BYTES,
    SIDECAR_SUFFIX,
    Recording,
    check_room,
    free_bytes,
    recording_s,
    repair_command,
)
from .registry import NAMES, PLAIN_NAMES, SIMULATED, camera_to_name, full_uri, open_camera
from .sdk import MAC_WHEEL, WHEEL, load_sdk, sdk_serial
from .session import QUEUED_SETS, find_streams
from .simulated import SimulatedCamera, SoftwareLidar
from .simulated_world import WORLDS, World, open_world, pack_loop, read_packaged, render_loop
from .streams import (
    FORMATS,
    FRAMES_PER_S,
    OPTIONAL,
    SAME_INSTANT_S,
    FrameSet,
    FrameSynchronizer,
    Sample,
    frame_in_si,
    intrinsics_of,
    sample_from_sdk,
    stream_name,
)
from .timestamps import WRAP_PERIOD_S, ClockUnwrap
