"""A set of streams, as a Frame in SI units."""

from collections.abc import Mapping

import numpy as np
from nlos_calibration.projection import Intrinsics

from nlos_cam.camera.streams import FrameSet
from nlos_cam.frames import Float32, Frame


def frame_in_si(
    found: FrameSet,
    unit_m: float,
    intrinsics: Intrinsics,
    settings: Mapping[str, float],
    truth_depth_m: Float32 | None = None,
) -> Frame:
    """The frame of a set whose depth counts in units of `unit_m`."""
    depth_m = found.depth_z16 * np.float32(unit_m)
    depth_m[found.depth_z16 == 0] = np.nan
    return Frame(
        depth_m=depth_m,
        ir=found.ir,
        confidence=found.confidence_raw8 >> np.uint8(4),
        timestamp_s=found.timestamp_s,
        frame_number=found.number,
        intrinsics=intrinsics,
        settings=settings,
        truth_depth_m=truth_depth_m,
    )
