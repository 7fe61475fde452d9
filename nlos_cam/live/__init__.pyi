__all__ = [
    "OUTSIDE_LATENCY",
    "REPORT",
    "SHIPPED",
    "SUFFIXES",
    "VIDEO",
    "BackgroundPhysicsCheck",
    "Choice",
    "FrameLog",
    "FrameReader",
    "Looks",
    "RunReport",
    "RunStatistics",
    "after_the_loop",
    "in_words",
    "iterate_results",
    "loader",
    "options_here",
    "precedence",
    "replay_recording",
    "run_live",
    "timer",
    "undisturbed",
    "warm_up",
    "with_telemetry",
    "within_budget",
]

from .budget import SHIPPED, Choice, loader, options_here, timer, within_budget
from .frame_log import SUFFIXES, FrameLog
from .frame_queue import FrameReader
from .loop import in_words, iterate_results, run_live, warm_up, with_telemetry
from .physics_check_process import BackgroundPhysicsCheck
from .realtime import after_the_loop, precedence, undisturbed
from .replay import REPORT, replay_recording
from .replay_media import VIDEO, Looks
from .statistics import OUTSIDE_LATENCY, RunReport, RunStatistics
