"""A measured wall made up in a moment: the paper's pose, and a reference that lies on its plane to
the last bit.
"""

from datetime import date
from typing import Any

import numpy as np
from nlos_calibration.board import BOARDS
from nlos_calibration.board_wall import BoardRecord
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWall
from nlos_calibration.rig import PinholeRecord, load_rig
from nlos_calibration.wall import wall_depth
from nlos_calibration.wall_record import MeasuredWall, WallRecord

WIDTH = 96
HEIGHT = 72
BOARD = BoardRecord(
    printed=BOARDS["a4"],
    measured=True,
    corners=24,
    residual_px=0.07,
    stretch=0.001,
    bow_m=0.0002,
    distance_m=0.2034,
    distance_std_m=0.0005,
    yaw_deg=40.1,
    yaw_std_deg=0.02,
    pitch_deg=40.1,
    pitch_std_deg=0.02,
    facing_deg=40.1,
    facing_std_deg=0.02,
    used="depth",
    disagreement_m=0.0034,
    disagreement_deg=0.117,
    disagreement_sigmas=6.5,
    causes=("printed at 97 %",),
)
"""A board that disagrees with the depth."""


def exact_wall(**fields: Any) -> MeasuredWall:
    """`fields` replace those of the reference; `reference=None` is a wall without one."""
    rig = load_rig("paper-rig")
    small = rig.pinhole.scaled(WIDTH, HEIGHT)
    rig = rig.model_copy(update={"intrinsics": PinholeRecord.model_validate(vars(small))})
    found: dict[str, Any] = {
        "distance_m": 0.2,
        "distance_std_m": 0.0001,
        "facing_deg": 45.0,
        "facing_std_deg": 0.01,
        "yaw_deg": 45.0,
        "yaw_std_deg": 0.01,
        "pitch_deg": 0.0,
        "pitch_std_deg": 0.02,
        "wall_from_lidar": rig.wall_from_lidar.tolist(),
        "temperatures_c": {"ldd_temperature": 41.7},
        "footprint_share": 1.0,
        "verdict": "good",
        "advice": "distance and angle are inside the paper's ranges",
        "rig": rig,
    }
    record = WallRecord(created=date(2026, 11, 22), camera="made-up", frames=30, **found)
    if "reference" in fields:
        return MeasuredWall(record, fields["reference"])
    return MeasuredWall(record, exact_reference(rig.wall_from_lidar, small, fields))


def exact_reference(pose: np.ndarray, intrinsics: Intrinsics, fields: dict[str, Any]) -> BareWall:
    """Reference of a wall at a pose, to the last bit; `fields` replace its own."""
    shape = (intrinsics.height, intrinsics.width)
    cells = (64, 80)
    exact: dict[str, Any] = {
        "depth_m": wall_depth(pose, intrinsics).astype(np.float32),
        "depth_std_m": np.full(shape, 0.0005, np.float32),
        "ir": np.full(shape, 40, np.float32),
        "ir_std": np.ones(shape, np.float32),
        "saturated": np.zeros(shape, np.float32),
        "inliers": np.ones(shape, np.bool_),
        "map_depth_m": wall_depth(pose, intrinsics.scaled(80, 64)).astype(np.float32),
        "map_depth_std_m": np.full(cells, 0.0005, np.float32),
        "map_intensity": np.full(cells, 40, np.float32),
        "map_intensity_std": np.ones(cells, np.float32),
    }
    return BareWall(**({"frames": 30, "intrinsics": intrinsics} | exact | fields))
