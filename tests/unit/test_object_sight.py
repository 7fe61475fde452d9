"""Shares of the box in sight, held against sights drawn one by one."""

import numpy as np
import pytest
from nlos_calibration.rig import Extent, LidarPose, ObjectBox, Occluder, Rig, load_rig
from nlos_calibration.rig_check import footprint, lidar_sees, wall_sees
from numpy.typing import NDArray

PAPER = load_rig("paper-rig")
BOX = PAPER.object_box or pytest.fail("the paper's rig hides something")


def rig(x_m: float, gap_m: float, distance_m: float = 0.2, yaw_deg: float = 45.0, pitch_deg: float = 0.0) -> Rig:
    lidar = LidarPose(distance_m=distance_m, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    return PAPER.model_copy(update={"lidar": lidar, "occluder": Occluder(x_m=x_m, z_min_m=gap_m)})


def points_in(box: ObjectBox, count: int = 40_000) -> NDArray[np.float64]:
    low = [box.x_min_m, box.y_min_m, box.z_near_m]
    return np.random.default_rng(0).uniform(low, [box.x_max_m, box.y_max_m, box.z_far_m], (count, 3))


def passes(rig: Rig, eye_m: NDArray[np.float64], points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the straight way from the eye (3,) to points (n, 3) misses the occluder."""
    share = (rig.occluder.x_m - eye_m[0]) / (points_m[:, 0] - eye_m[0])
    return eye_m[2] + share * (points_m[:, 2] - eye_m[2]) < rig.occluder.z_min_m


@pytest.mark.parametrize(
    "bench",
    [
        rig(0.2, 0.1),
        rig(0.2, 0.2),
        rig(0.3, 0.15, yaw_deg=50.0, pitch_deg=10.0),
        rig(0.2, 0.18, 0.15, 70.0),
        rig(0.25, 0.22, 0.2, 75.0, -30.0),
    ],
)
def test_the_lidar_sees_as_much_as_sights_drawn_one_by_one(bench: Rig) -> None:
    points_m, pose, pinhole = points_in(BOX), bench.wall_from_lidar, bench.pinhole
    seen = (points_m - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(divide="ignore"):
        column, row = pinhole.fx * seen[:, 0] / seen[:, 2] + pinhole.ppx, pinhole.fy * seen[:, 1] / seen[:, 2]
    row = row + pinhole.ppy
    inside = (seen[:, 2] > 0) & (column > -0.5) & (column < 639.5) & (row > -0.5) & (row < 479.5)
    share = (inside & passes(bench, pose[:3, 3], points_m)).mean()
    assert lidar_sees(bench, BOX) == pytest.approx(share, abs=0.008)


def test_without_an_occluder_only_the_field_of_view_hides() -> None:
    bare = rig(0.2, 0.1, yaw_deg=70.0).model_copy(update={"occluder": None})
    assert lidar_sees(bare, BOX) > 0.7
    assert lidar_sees(rig(0.2, 0.1, yaw_deg=70.0), BOX) == 0.0


@pytest.mark.parametrize("bench", [rig(0.2, 0.1, yaw_deg=-45.0), rig(0.3, 0.05, 0.15, 15.0), rig(0.2, 0.1)])
def test_the_wall_sees_as_much_as_its_best_lit_cell(bench: Rig) -> None:
    seen = footprint(bench.wall_from_lidar, bench.pinhole, bench.wall)
    cells = seen.cells_m[32][seen.on_wall[32]]
    points_m, lidar_m = points_in(BOX, 4000), bench.wall_from_lidar[:3, 3]
    feet_m = np.column_stack([cells, np.zeros(len(cells))])
    lit = [foot for foot in feet_m if foot[0] <= bench.occluder.x_m or passes(bench, lidar_m, foot[np.newaxis])[0]]
    best = max((passes(bench, foot, points_m) | (foot[0] >= bench.occluder.x_m)).mean() for foot in lit)
    assert wall_sees(bench, BOX, seen) == pytest.approx(best, abs=0.03)


def test_a_wall_that_is_not_lit_sees_nothing() -> None:
    away = Extent(x_min_m=-3.0, x_max_m=-2.0, y_min_m=-1.0, y_max_m=1.0)
    bench = rig(0.2, 0.1)
    assert wall_sees(bench, BOX, footprint(bench.wall_from_lidar, bench.pinhole, away)) == 0.0


def test_the_wall_behind_the_sheet_is_dark() -> None:
    bench = rig(0.2, 0.001, yaw_deg=60.0)
    beyond = Extent(x_min_m=0.21, x_max_m=2.0, y_min_m=-1.0, y_max_m=1.0)
    assert wall_sees(bench, BOX, footprint(bench.wall_from_lidar, bench.pinhole, beyond)) == 0.0
    opened = rig(0.2, 0.1, yaw_deg=60.0)
    assert wall_sees(opened, BOX, footprint(opened.wall_from_lidar, opened.pinhole, beyond)) == 1.0
