__all__ = [
    "UNEXPLAINED",
    "WALL_GRID",
    "Arrival",
    "CalibratedRig",
    "Clock",
    "EdgeRepair",
    "FrameConditions",
    "FrameReader",
    "FrameResult",
    "FrozenFrames",
    "MapAlignment",
    "OnWarning",
    "OwnMaps",
    "PeriodicPhysicsCheck",
    "PhysicsCheck",
    "PhysicsCheckResult",
    "Pipeline",
    "PreparedFrame",
    "Quality",
    "QualityLog",
    "RecentValues",
    "Reconstruction",
    "Verdict",
    "VerdictFilter",
    "WarningLog",
    "WarningSpan",
    "WeightsVerdict",
    "align_all",
    "align_samples",
    "alignment",
    "build_pipeline",
    "can_align",
    "check_intrinsics",
    "check_reconstruction",
    "compatibility_warnings",
    "describe_counts",
    "describe_failure",
    "edge_cells",
    "estimate_uncertainty",
    "frame_issues",
    "frames_by_verdict",
    "grid_of",
    "ignore",
    "is_wall_grid",
    "iterate_batched",
    "iterate_results",
    "load_networks",
    "load_uncertainty",
    "log_warning",
    "measured_counts",
    "occluder_assumed",
    "open_bench",
    "reconstruct",
    "rig_to_align_with",
    "verdict_limits",
    "warm_up",
    "weights_for",
    "weights_serve",
]

from .alignment import (
    MapAlignment,
    align_all,
    align_samples,
    alignment,
    can_align,
    rig_to_align_with,
)
from .bench import CalibratedRig, check_intrinsics, occluder_assumed, open_bench
from .edge import EdgeRepair, edge_cells
from .flat_field import measured_counts
from .frame_reader import Arrival, FrameReader, ignore
from .network import Clock, Quality, Reconstruction, estimate_uncertainty, reconstruct
from .own_maps import OwnMaps
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
    FrameResult,
    Pipeline,
    PreparedFrame,
    build_pipeline,
    compatibility_warnings,
    load_networks,
    load_uncertainty,
    verdict_limits,
)
from .serving import WeightsVerdict, weights_for, weights_serve
from .streaming import iterate_batched, iterate_results, warm_up
from .summaries import (
    OnWarning,
    QualityLog,
    RecentValues,
    WarningLog,
    WarningSpan,
    describe_counts,
    frames_by_verdict,
)
from .verdict import FrameConditions, FrozenFrames, Verdict, VerdictFilter, frame_issues
from .wall_grid import WALL_GRID, grid_of, is_wall_grid
