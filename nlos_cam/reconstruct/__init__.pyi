__all__ = [
    "UNEXPLAINED",
    "Arrival",
    "CalibratedRig",
    "Clock",
    "EveryFrames",
    "FrameConditions",
    "FrameResult",
    "PhysicsCheck",
    "PhysicsCheckResult",
    "Pipeline",
    "PreparedFrame",
    "Reconstruction",
    "Verdict",
    "VerdictFilter",
    "check",
    "check_intrinsics",
    "failure",
    "frame_issues",
    "limits_of",
    "load_doubt",
    "load_networks",
    "log_warning",
    "misfits",
    "open_bench",
    "reconstruct",
    "set_up",
]

from .bench import CalibratedRig, check_intrinsics, open_bench
from .network import Clock, Reconstruction, reconstruct
from .physics_check import UNEXPLAINED, EveryFrames, PhysicsCheck, PhysicsCheckResult, check, failure, log_warning
from .pipeline import (
    Arrival,
    FrameResult,
    Pipeline,
    PreparedFrame,
    limits_of,
    load_doubt,
    load_networks,
    misfits,
    set_up,
)
from .verdict import FrameConditions, Verdict, VerdictFilter, frame_issues
