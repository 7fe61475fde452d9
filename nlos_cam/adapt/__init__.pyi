__all__ = [
    "AdaptResult",
    "Adaptation",
    "Plan",
    "Stage",
    "adapt",
    "bench_sensor",
    "calibration_spread",
    "install",
]

from .plan import Plan, Stage, bench_sensor, calibration_spread
from .run import Adaptation, AdaptResult, adapt, install
