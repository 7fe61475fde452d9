__all__ = [
    "NETWORK_FILE",
    "OBJECTS",
    "PLAN",
    "RECORDINGS",
    "AdaptResult",
    "Adaptation",
    "Locked",
    "LockedNoise",
    "Measure",
    "Pace",
    "Plan",
    "Recordings",
    "Stage",
    "Tables",
    "Transfer",
    "adapt",
    "bench_sensor",
    "calibration_spread",
    "find_recordings",
    "install",
    "transfer_words",
    "write_page",
]

from .job import OBJECTS, Adaptation
from .locked import LockedNoise
from .plan import PLAN, Locked, Pace, Plan, Stage, bench_sensor, calibration_spread
from .recordings import RECORDINGS, Recordings, Transfer, find_recordings
from .report import Tables, transfer_words, write_page
from .run import (
    NETWORK_FILE,
    AdaptResult,
    Measure,
    adapt,
    install,
)
