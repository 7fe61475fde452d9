"""Grid of cells on the relay wall, with which the maps of any bench are aligned: one frame of
reference for networks that know many rigs.

The grid is written as a rig without an occluder that looks at the wall straight on. What a bench
does not see of it is a cell without a return. Where on the wall a hidden surface can be seen from
depends on the rig too, so networks get its numbers as well: in the grid's last column, which lies
beyond the hidden object's middle, as depths.
"""

import numpy as np
from nlos_calibration import (
    DISTANCE_RANGE_M,
    FACING_RANGE_DEG,
    GAP_RANGE_M,
    TOLERANCE_DEG,
    TOLERANCE_M,
    Extent,
    LidarPose,
    ObjectBox,
    PinholeRecord,
    Rig,
)
from nlos_calibration.arrays import Float32
from nlos_models import CheckpointRecord

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS
from nlos_cam.objects import object_box

CELL_M = 0.007
"""About a cell of a lidar at 0.20 m near its foot, where cells are smallest."""
X_MIN_M = -0.06
_DISTANCE_M = 0.45
_PINHOLE = PinholeRecord()
_FX = _PINHOLE.width * _DISTANCE_M / (MAP_COLUMNS * CELL_M)
_FY = _PINHOLE.height * _DISTANCE_M / (MAP_ROWS * CELL_M)

_BOX = ObjectBox(
    x_min_m=0.325, x_max_m=0.575, y_min_m=-0.125, y_max_m=0.125, z_near_m=0.12, z_far_m=0.40
)
WALL_GRID = Rig(
    name="wall grid",
    lidar=LidarPose(distance_m=_DISTANCE_M, yaw_deg=0.0),
    intrinsics=PinholeRecord(fx=_FX, fy=_FY, ppx=-0.5 - _FX * X_MIN_M / _DISTANCE_M),
    wall=Extent(x_min_m=-1.0, x_max_m=2.0, y_min_m=-1.5, y_max_m=1.5),
    relay=Extent(x_min_m=0.0, x_max_m=0.5, y_min_m=-0.25, y_max_m=0.25),
    object_box=_BOX,
)
"""The grid as a rig: 64 x 80 cells of 7 mm, from 0.06 m before the foot of the paper's lidar to
0.50 m beyond it."""

PITCH_RANGE_DEG = -2.0, 2.0
ALONG_RANGE_M = -0.05, 0.05
"""Move of the lidar's foot along the wall, away from the object box, from where the grid has it."""
ASIDE_RANGE_M = -0.01, 0.01
"""Place of the box's middle, wall y."""
OCCLUDER_RANGE_M = -0.02, 0.02
"""Move of the occluder along the wall, against the box, from USUAL_OCCLUDER_M."""
USUAL_OCCLUDER_M = -0.125
"""Place of the paper's occluder along the wall, from the box's near end."""

NUMBERS_COLUMN = MAP_COLUMNS - 1
ROWS_PER_NUMBER = 4
"""A network's patch: each number fills one in either half of the maps."""
EVEN, ODD = 5, 2
"""Numbers that are the same for the mirrored rig, and those that change their sign."""


def is_wall_grid(rig: Rig) -> bool:
    """Return whether a rig is the grid, by its checksum, as weights store it."""
    return rig.checksum == WALL_GRID.checksum


def grid_of(trained: CheckpointRecord) -> Rig | None:
    """Return the grid for weights that were trained on it, else None."""
    return WALL_GRID if trained.rig_checksum == WALL_GRID.checksum else None


def rig_in_words(trained: CheckpointRecord) -> str:
    """Return the name of the rig that weights were trained for, `any rig` for those that know many."""
    return "any rig" if grid_of(trained) and not trained.rig else trained.rig_name


def rig_numbers(rig: Rig) -> Float32:
    """Return the numbers (7,) of a rig, each of about one unit over the rigs that the paper allows.

    Distance and yaw of the lidar, occluder against box, gap, box against the lidar's foot; then
    pitch and the box's middle aside, which are odd. Raises SceneError for a rig without an occluder
    or a box.
    """
    box = object_box(rig)
    if rig.occluder is None:
        raise SceneError(f"{rig.name} has no occluder: networks for any rig need its place")
    middle_m = (box.y_min_m + box.y_max_m) / 2
    even = [
        (rig.lidar.distance_m - 0.225) / 0.05,
        (rig.lidar.yaw_deg - 45) / 20,
        (rig.occluder.x_m - box.x_min_m - USUAL_OCCLUDER_M) / 0.02,
        (rig.occluder.z_min_m - 0.1) / 0.03,
        (box.x_min_m - _BOX.x_min_m) / 0.03,
    ]
    odd = [rig.lidar.pitch_deg / 2, middle_m / 0.01]
    return np.array([*even, *odd], np.float32)


def numbers_column(numbers: Float32) -> Float32:
    """Return the column (64,) of maps that holds a rig's numbers.

    Mirrored maps hold the mirrored rig's numbers: odd ones have the other sign in the lower half.
    """
    column = np.zeros(MAP_ROWS, np.float32)
    upper = np.repeat(numbers, ROWS_PER_NUMBER)
    signs = np.repeat(np.array([1.0] * EVEN + [-1.0] * ODD, np.float32), ROWS_PER_NUMBER)
    column[: upper.size] = upper
    column[MAP_ROWS - upper.size :] = (signs * upper)[::-1]
    return column


def beyond_trained(rig: Rig) -> list[str]:
    """Return a phrase for each number of a rig that is beyond the rigs which networks on the wall grid
    are trained on (`dataset.RigRange`); the occluder's only where there is one. Raises SceneError for
    a rig without a box.
    """
    box = object_box(rig)
    lidar = rig.lidar
    found = [
        _beyond("distance", lidar.distance_m, "m", DISTANCE_RANGE_M),
        _beyond("yaw", lidar.yaw_deg, "degrees", FACING_RANGE_DEG),
        _beyond("pitch", lidar.pitch_deg, "degrees", PITCH_RANGE_DEG),
        _beyond("box moved along the wall by", box.x_min_m - _BOX.x_min_m, "m", ALONG_RANGE_M),
        _beyond("box moved up by", (box.y_min_m + box.y_max_m) / 2, "m", ASIDE_RANGE_M),
    ]
    if occluder := rig.occluder:
        move_m = occluder.x_m - box.x_min_m - USUAL_OCCLUDER_M
        found.append(_beyond("gap", occluder.z_min_m, "m", GAP_RANGE_M))
        found.append(_beyond("occluder moved by", move_m, "m", OCCLUDER_RANGE_M))
    return [each for each in found if each]


def _beyond(name: str, value: float, unit: str, trained: tuple[float, float]) -> str:
    """Return a phrase on a number beyond its range; empty within it."""
    low, high = trained
    # A calibration may be off by its tolerance.
    allowed = TOLERANCE_M if unit == "m" else TOLERANCE_DEG
    if low - allowed <= value <= high + allowed:
        return ""
    shown = round(value, 3 if unit == "m" else 1) + 0.0  # no "-0"
    return f"{name} {shown:g} {unit}, {low:g} to {high:g} trained"
