__all__ = [
    "UNEXPLAINED",
    "Arrival",
    "CalibratedRig",
    "Clock",
    "FrameConditions",
    "FrameResult",
    "Mirrored",
    "PeriodicPhysicsCheck",
    "PhysicsCheck",
    "PhysicsCheckResult",
    "Pipeline",
    "PreparedFrame",
    "Quality",
    "Reconstruction",
    "Verdict",
    "VerdictFilter",
    "build_pipeline",
    "check_intrinsics",
    "check_reconstruction",
    "compatibility_warnings",
    "describe_failure",
    "frame_issues",
    "load_networks",
    "load_uncertainty",
    "log_warning",
    "open_bench",
    "reconstruct",
    "verdict_limits",
]

from .bench import CalibratedRig, check_intrinsics, open_bench
from .network import Clock, Mirrored, Quality, Reconstruction, reconstruct
from .physics_check import (
    UNEXPLAINED,
    PeriodicPhysicsCheck,
    PhysicsCheck,
    PhysicsCheckResult,
    check_reconstruction,
    describe_failure,
    log_warning,
)
from .pipeline import (
    Arrival,
    FrameResult,
    Pipeline,
    PreparedFrame,
    build_pipeline,
    compatibility_warnings,
    load_networks,
    load_uncertainty,
    verdict_limits,
)
from .verdict import FrameConditions, Verdict, VerdictFilter, frame_issues
