__all__ = [
    "NETWORK_FILE",
    "AdaptResult",
    "Adaptation",
    "Plan",
    "Stage",
    "adapt",
    "bench_sensor",
    "calibration_spread",
    "install",
    "write_page",
]

from .plan import Plan, Stage, bench_sensor, calibration_spread
from .report import write_page
from .run import NETWORK_FILE, Adaptation, AdaptResult, adapt, install
