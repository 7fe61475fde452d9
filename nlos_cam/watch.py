"""A glance at the wall in a single frame, for somebody who is positioning the lidar: where it is, what to move."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float32
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.projection import Intrinsics
from nlos_calibration.wall import WallFit, fit_wall

from nlos_cam.frames import Frame, saturated_share

GLANCE_COLUMNS = 160
"""A frame is thinned to about so many: a plane is still sure to a tenth of a millimetre."""


@dataclass(frozen=True)
class Glance:
    """What one frame says of the wall."""

    fit: WallFit | None
    refused: str
    """Why there is no fit; empty where there is one."""
    saturated: float
    """Share of the pixels whose IR is at its full scale."""


def glance(frame: Frame) -> Glance:
    """Fit the wall in one frame, thinned. The same frame gives the same glance."""
    depth_m, intrinsics = thinned(frame.depth_m, frame.intrinsics)
    saturated = saturated_share(frame.ir)
    try:
        fit = fit_wall(depth_m, intrinsics, np.random.default_rng(0))
    except WallRefusedError as error:
        return Glance(None, str(error), saturated)
    return Glance(fit, "", saturated)


def thinned(depth_m: Float32, intrinsics: Intrinsics) -> tuple[Float32, Intrinsics]:
    """Every n-th pixel of every n-th row, and the intrinsics that these have."""
    step = max(1, round(intrinsics.width / GLANCE_COLUMNS))
    first = step // 2
    few = depth_m[first::step, first::step]
    centre = (intrinsics.ppx - first) / step, (intrinsics.ppy - first) / step
    return few, Intrinsics(few.shape[1], few.shape[0], intrinsics.fx / step, intrinsics.fy / step, *centre)
