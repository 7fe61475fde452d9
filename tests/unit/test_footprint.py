import numpy as np
import pytest
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.rig import Extent, load_rig
from nlos_calibration.rig_check import footprint, on_plane
from numpy.typing import NDArray

PINHOLE = load_rig("bare-wall").pinhole
WALL = Extent(x_min_m=-1.0, x_max_m=2.0, y_min_m=-1.5, y_max_m=1.5)


def pose(yaw_deg: float, pitch_deg: float = 0.0, distance_m: float = 0.2) -> NDArray[np.float64]:
    return wall_from_plane(normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m)


def test_a_wall_faced_squarely_is_seen_as_wide_as_the_field_of_view() -> None:
    seen = footprint(pose(0.0), PINHOLE, WALL)
    wide, tall = 0.2 * np.tan(np.radians(35.0)), 0.2 * np.tan(np.radians(27.5))
    expected = [[-wide, tall], [wide, tall], [wide, -tall], [-wide, -tall]]
    np.testing.assert_allclose(seen.corners_m, expected, atol=1e-6)
    assert seen.cells_m.shape == (64, 80, 2)
    assert seen.share == 1.0


def test_rows_run_from_the_near_side_to_the_far_and_the_first_is_on_top() -> None:
    cells_m = footprint(pose(45.0), PINHOLE, WALL).cells_m
    assert (np.diff(cells_m[..., 0], axis=1) > 0.0).all()
    assert (np.diff(cells_m[..., 1], axis=0) < 0.0).all()


def test_the_papers_footprint_runs_from_4_cm_to_more_than_a_metre() -> None:
    corners_m = footprint(pose(45.0), PINHOLE, WALL).corners_m
    assert corners_m[[0, 3], 0] == pytest.approx(0.2 * np.tan(np.radians(10.0)))
    assert corners_m[[1, 2], 0] == pytest.approx(0.2 * np.tan(np.radians(80.0)))


def test_cells_lie_on_the_plane_along_their_beams() -> None:
    wall_from_lidar = pose(40.0, 10.0)
    rays = PINHOLE.scaled(80, 64).rays()
    points = footprint(wall_from_lidar, PINHOLE, WALL).cells_m
    world = np.concatenate([points, np.zeros((64, 80, 1)), np.ones((64, 80, 1))], axis=-1)
    lidar = (world @ np.linalg.inv(wall_from_lidar).T)[..., :3]
    np.testing.assert_allclose(lidar / lidar[..., 2:], rays, atol=1e-9)


def test_beams_that_never_meet_the_wall_have_no_point_and_no_share() -> None:
    seen = footprint(pose(75.0), PINHOLE, WALL)
    away = np.isnan(seen.cells_m).any(axis=-1)
    assert away.any()
    assert not seen.on_wall[away].any()
    assert np.isnan(seen.corners_m[1]).all()
    assert np.isfinite(seen.corners_m[0]).all()


def test_the_share_is_of_the_cells_within_the_extent() -> None:
    half = Extent(x_min_m=-1.0, x_max_m=0.0, y_min_m=-1.0, y_max_m=1.0)
    assert footprint(pose(0.0), PINHOLE, half).share == pytest.approx(0.5)
    assert footprint(pose(0.0), PINHOLE, half, shape=(3, 4)).on_wall.tolist() == [[True, True, False, False]] * 3


def test_a_lidar_that_looks_away_sees_nothing() -> None:
    assert np.isnan(on_plane(pose(180.0), np.array([[0.0, 0.0, 1.0]]))).all()
