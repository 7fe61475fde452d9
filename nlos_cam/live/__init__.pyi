__all__ = [
    "LOG_SUFFIXES",
    "OBJECT_FORMATS",
    "OUTSIDE_LATENCY",
    "REPORT",
    "SHIPPED",
    "VIDEO",
    "BackgroundPhysicsCheck",
    "BudgetChoice",
    "FrameLog",
    "FrameReader",
    "Playback",
    "ReplayMedia",
    "RunControl",
    "RunReport",
    "RunStatistics",
    "available_settings",
    "choose_within_budget",
    "describe_counts",
    "export_objects",
    "ignore",
    "iterate_results",
    "low_latency_interpreter",
    "offer_settings",
    "pipeline_timer",
    "realtime_priority",
    "replay_recording",
    "run_live",
    "setting_loader",
    "warm_up",
    "with_telemetry",
    "yield_to_loop",
]

from .budget import (
    SHIPPED,
    BudgetChoice,
    available_settings,
    choose_within_budget,
    offer_settings,
    pipeline_timer,
    setting_loader,
)
from .control import RunControl
from .frame_log import LOG_SUFFIXES, FrameLog
from .frame_queue import FrameReader, ignore
from .loop import describe_counts, iterate_results, run_live, warm_up
from .object_files import OBJECT_FORMATS, export_objects
from .physics_check_process import BackgroundPhysicsCheck
from .playback import Playback
from .realtime import low_latency_interpreter, realtime_priority, yield_to_loop
from .replay import REPORT, replay_recording
from .replay_media import VIDEO, ReplayMedia
from .statistics import OUTSIDE_LATENCY, RunReport, RunStatistics
from .telemetry import with_telemetry
