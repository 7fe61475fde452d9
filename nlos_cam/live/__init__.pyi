__all__ = [
    "LOG_SUFFIXES",
    "OUTSIDE_LATENCY",
    "BackgroundPhysicsCheck",
    "FrameLog",
    "Priority",
    "RealtimePriority",
    "RunControl",
    "RunReport",
    "RunStatistics",
    "low_latency_interpreter",
    "run_live",
    "yield_to_loop",
]

from .control import RunControl
from .frame_log import LOG_SUFFIXES, FrameLog
from .loop import run_live
from .physics_check_process import BackgroundPhysicsCheck
from .realtime import Priority, RealtimePriority, low_latency_interpreter, yield_to_loop
from .statistics import OUTSIDE_LATENCY, RunReport, RunStatistics
