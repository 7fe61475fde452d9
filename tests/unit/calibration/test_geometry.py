import numpy as np
import pytest
from nlos_calibration import Intrinsics, facing_angle_rad, normal_from_angles, wall_from_plane
from nlos_calibration.arrays import Float64
from nlos_calibration.geometry import angles_from_normal

PINHOLE = Intrinsics(640, 480, 457.0, 461.0, 318.0, 241.0)
DISTANCE_M = 0.23
ANGLES = [(yaw, pitch) for yaw in (-1.2, -0.3, 0.0, 0.8, 1.3) for pitch in (-1.0, 0.0, 0.4)]


@pytest.fixture(params=ANGLES)
def angles_rad(request: pytest.FixtureRequest) -> tuple[float, float]:
    return request.param


@pytest.fixture
def pose(angles_rad: tuple[float, float]) -> Float64:
    return wall_from_plane(normal_from_angles(*angles_rad), DISTANCE_M)


def test_normal_is_of_unit_length_and_keeps_its_angles(angles_rad: tuple[float, float]) -> None:
    normal = normal_from_angles(*angles_rad)

    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert angles_from_normal(normal) == pytest.approx(angles_rad)


def test_wall_pose_is_a_rotation(pose: Float64) -> None:
    rotation = pose[:3, :3]

    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_wall_pose_puts_the_lidar_above_the_origin(pose: Float64) -> None:
    lidar = pose @ [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(lidar, [0.0, 0.0, DISTANCE_M, 1.0], atol=1e-12)


def test_wall_x_is_the_lidars_x_axis_projected(pose: Float64) -> None:
    along_x, along_y, _ = pose[:3, 0]

    assert along_x > 0.0
    assert along_y == pytest.approx(0.0, abs=1e-12)


def test_wall_pose_faces_along_the_normal(pose: Float64, angles_rad: tuple[float, float]) -> None:
    normal = normal_from_angles(*angles_rad)
    assert facing_angle_rad(pose) == pytest.approx(np.arccos(-normal[2]), abs=1e-7)


def test_wall_pose_needs_no_unit_normal(pose: Float64, angles_rad: tuple[float, float]) -> None:
    longer = 3.0 * normal_from_angles(*angles_rad)
    np.testing.assert_allclose(wall_from_plane(longer, DISTANCE_M), pose, atol=1e-12)


def test_wall_y_points_up() -> None:
    level = wall_from_plane(normal_from_angles(0.0, 0.0), 0.2)
    np.testing.assert_allclose(level[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_positive_angles_turn_the_axis_to_wall_x_and_y() -> None:
    axis = wall_from_plane(normal_from_angles(0.5, 0.3), 0.2)[:3, 2]
    assert np.sign(axis).tolist() == [1.0, 1.0, -1.0]


def test_wall_pose_refuses_a_lidar_whose_x_axis_is_the_normal() -> None:
    with pytest.raises(ValueError, match="lidar"):
        wall_from_plane(np.array([1.0, 0.0, 0.0]), 0.2)


def test_rays_lead_back_to_their_pixels() -> None:
    rays = PINHOLE.rays()
    columns = rays[..., 0] * PINHOLE.fx + PINHOLE.ppx
    rows = rays[..., 1] * PINHOLE.fy + PINHOLE.ppy

    np.testing.assert_allclose(columns, np.tile(np.arange(640), (480, 1)), atol=1e-9)
    np.testing.assert_allclose(rows[:, 0], np.arange(480), atol=1e-9)
    assert (rays[..., 2] == 1.0).all()


def test_matrix_projects_points_on_a_ray_to_its_pixel() -> None:
    columns, rows = np.meshgrid(np.arange(0, 640, 89), np.arange(0, 480, 97))
    points = 0.7 * PINHOLE.rays()[rows, columns].reshape(-1, 3)
    seen = points @ PINHOLE.matrix.T
    pixels = np.column_stack([columns.ravel(), rows.ravel()])

    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], pixels, atol=1e-9)


def edges(pinhole: Intrinsics) -> list[float]:
    """Return x of the left edge and y of the lower edge of the field, at unit depth."""
    left = (-0.5 - pinhole.ppx) / pinhole.fx
    bottom = (pinhole.height - 0.5 - pinhole.ppy) / pinhole.fy
    return [left, bottom]


@pytest.mark.parametrize("size", [(80, 64), (1024, 768), (640, 480)])
def test_scaled_intrinsics_keep_the_edges_of_the_field(size: tuple[int, int]) -> None:
    scaled = PINHOLE.scaled(*size)

    assert edges(scaled) == pytest.approx(edges(PINHOLE))
    assert scaled.scaled(640, 480).ppx == pytest.approx(PINHOLE.ppx)
