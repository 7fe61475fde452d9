__all__ = [
    "OUTSIDE_LATENCY",
    "REPORT",
    "SHIPPED",
    "SUFFIXES",
    "VIDEO",
    "BackgroundPhysicsCheck",
    "BudgetChoice",
    "FrameLog",
    "FrameReader",
    "Looks",
    "RunReport",
    "RunStatistics",
    "available_options",
    "choose_within_budget",
    "describe_counts",
    "iterate_results",
    "loader",
    "low_latency_interpreter",
    "realtime_priority",
    "replay_recording",
    "run_live",
    "timer",
    "warm_up",
    "with_telemetry",
    "yield_to_loop",
]

from .budget import SHIPPED, BudgetChoice, available_options, choose_within_budget, loader, timer
from .frame_log import SUFFIXES, FrameLog
from .frame_queue import FrameReader
from .loop import describe_counts, iterate_results, run_live, warm_up, with_telemetry
from .physics_check_process import BackgroundPhysicsCheck
from .realtime import low_latency_interpreter, realtime_priority, yield_to_loop
from .replay import REPORT, replay_recording
from .replay_media import VIDEO, Looks
from .statistics import OUTSIDE_LATENCY, RunReport, RunStatistics
