import numpy as np
import pytest
from nlos_calibration.geometry import angles_from_normal, facing_angle_rad, normal_from_angles, wall_from_plane

ANGLES = [(yaw, pitch) for yaw in (-1.2, -0.3, 0.0, 0.8, 1.3) for pitch in (-1.0, 0.0, 0.4)]


@pytest.mark.parametrize("angles", ANGLES)
def test_angles_and_normal_are_inverse(angles: tuple[float, float]) -> None:
    normal = normal_from_angles(*angles)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert angles_from_normal(normal) == pytest.approx(angles)


@pytest.mark.parametrize("angles", ANGLES)
def test_the_pose_is_rigid_and_right_handed(angles: tuple[float, float]) -> None:
    rotation = wall_from_plane(normal_from_angles(*angles), 0.2)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("angles", ANGLES)
def test_the_lidar_stands_over_the_origin(angles: tuple[float, float]) -> None:
    pose = wall_from_plane(normal_from_angles(*angles), 0.23)
    np.testing.assert_allclose(pose @ [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.23, 1.0], atol=1e-12)


@pytest.mark.parametrize("angles", ANGLES)
def test_the_lidars_x_axis_has_no_part_along_wall_y(angles: tuple[float, float]) -> None:
    pose = wall_from_plane(normal_from_angles(*angles), 0.2)
    assert pose[1, 0] == pytest.approx(0.0, abs=1e-12)
    assert pose[0, 0] > 0.0


def test_a_level_lidar_facing_the_wall_has_up_as_wall_y() -> None:
    pose = wall_from_plane(normal_from_angles(0.0, 0.0), 0.2)
    np.testing.assert_allclose(pose[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_positive_yaw_turns_the_axis_to_wall_x_and_positive_pitch_to_wall_y() -> None:
    axis = wall_from_plane(normal_from_angles(0.5, 0.3), 0.2)[:3, 2]
    assert axis[0] > 0.0
    assert axis[1] > 0.0
    assert axis[2] < 0.0


@pytest.mark.parametrize("angles", ANGLES)
def test_facing_is_the_angle_between_axis_and_normal(angles: tuple[float, float]) -> None:
    normal = normal_from_angles(*angles)
    expected = np.arccos(-normal[2])
    assert facing_angle_rad(wall_from_plane(normal, 0.2)) == pytest.approx(expected, abs=1e-7)


def test_the_normals_length_does_not_matter() -> None:
    normal = normal_from_angles(0.7, 0.1)
    np.testing.assert_allclose(wall_from_plane(3.0 * normal, 0.2), wall_from_plane(normal, 0.2), atol=1e-12)


def test_a_wall_across_the_lidars_x_axis_has_no_frame() -> None:
    with pytest.raises(ValueError, match="turn the lidar"):
        wall_from_plane(np.array([1.0, 0.0, 0.0]), 0.2)
