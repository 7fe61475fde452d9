import numpy as np
import pytest
from nlos_calibration import Intrinsics, facing_angle_rad, normal_from_angles, wall_from_plane
from nlos_calibration.geometry import angles_from_normal

ANGLES = [(yaw, pitch) for yaw in (-1.2, -0.3, 0.0, 0.8, 1.3) for pitch in (-1.0, 0.0, 0.4)]
PINHOLE = Intrinsics(640, 480, 457.0, 461.0, 318.0, 241.0)


@pytest.mark.parametrize("angles", ANGLES)
def test_wall_pose_is_rigid_above_the_origin_and_level(angles: tuple[float, float]) -> None:
    normal = normal_from_angles(*angles)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert angles_from_normal(normal) == pytest.approx(angles)
    pose = wall_from_plane(normal, 0.23)
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(pose @ [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.23, 1.0], atol=1e-12)
    assert pose[1, 0] == pytest.approx(
        0.0, abs=1e-12
    )  # the lidar's x axis has no component along wall y
    assert pose[0, 0] > 0.0
    assert facing_angle_rad(pose) == pytest.approx(np.arccos(-normal[2]), abs=1e-7)
    np.testing.assert_allclose(wall_from_plane(3.0 * normal, 0.23), pose, atol=1e-12)


def test_wall_pose_has_up_as_y_and_positive_angles_to_x_and_y() -> None:
    level = wall_from_plane(normal_from_angles(0.0, 0.0), 0.2)
    np.testing.assert_allclose(level[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    axis = wall_from_plane(normal_from_angles(0.5, 0.3), 0.2)[:3, 2]
    assert np.sign(axis).tolist() == [1.0, 1.0, -1.0]
    with pytest.raises(ValueError, match="lidar"):
        wall_from_plane(np.array([1.0, 0.0, 0.0]), 0.2)


def test_intrinsics_project_each_ray_back_to_its_pixel() -> None:
    rays = PINHOLE.rays()
    np.testing.assert_allclose(
        rays[..., 0] * PINHOLE.fx + PINHOLE.ppx, np.tile(np.arange(640), (480, 1)), atol=1e-9
    )
    np.testing.assert_allclose(rays[:, 0, 1] * PINHOLE.fy + PINHOLE.ppy, np.arange(480), atol=1e-9)
    assert (rays[..., 2] == 1.0).all()
    seen = 0.7 * rays[::97, ::89].reshape(-1, 3) @ PINHOLE.matrix.T
    columns, rows = np.meshgrid(np.arange(640)[::89], np.arange(480)[::97])
    np.testing.assert_allclose(
        seen[:, :2] / seen[:, 2:], np.column_stack([columns.ravel(), rows.ravel()]), atol=1e-9
    )


@pytest.mark.parametrize("size", [(80, 64), (1024, 768), (640, 480)])
def test_scaled_intrinsics_keep_the_edges_of_the_field(size: tuple[int, int]) -> None:
    scaled = PINHOLE.scaled(*size)
    for whole, part in ((PINHOLE, scaled), (scaled, PINHOLE)):
        assert (-0.5 - part.ppx) / part.fx == pytest.approx((-0.5 - whole.ppx) / whole.fx)
        assert (part.height - 0.5 - part.ppy) / part.fy == pytest.approx(
            (whole.height - 0.5 - whole.ppy) / whole.fy
        )
    assert scaled.scaled(640, 480).ppx == pytest.approx(PINHOLE.ppx)
