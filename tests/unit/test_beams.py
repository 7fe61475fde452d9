"""The first leg: where beams land, on what, and what S1 returns from there."""

import numpy as np
import pytest
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Extent, LidarPose, Occluder, Rig, load_rig

from nlos_cam.render.beams import SPEED_OF_LIGHT_M_PER_S, cast

BARE, PAPER = load_rig("bare-wall"), load_rig("paper-rig")


def _cells(rig: Rig) -> Intrinsics:
    return rig.pinhole.scaled(80, 64)


def _lidar(**pose: float) -> Rig:
    return BARE.model_copy(update={"lidar": LidarPose.model_validate({"distance_m": 0.2, "yaw_deg": 45.0} | pose)})


@pytest.mark.parametrize("yaw_deg", [0.0, 15.0, 45.0, -45.0])
@pytest.mark.parametrize("pitch_deg", [0.0, 10.0])
def test_beams_land_on_the_plane_of_the_wall_along_their_pixels_ray(yaw_deg: float, pitch_deg: float) -> None:
    rig = _lidar(yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    beams = cast(rig, _cells(rig))
    np.testing.assert_allclose(beams.foot_m[beams.on_wall, 2], 0, atol=1e-12)
    pose = rig.wall_from_lidar
    back = (beams.foot_m[beams.on_wall] - pose[:3, 3]) @ pose[:3, :3]
    rays = _cells(rig).rays().reshape(-1, 3)[beams.on_wall]
    np.testing.assert_allclose(back / back[:, 2:], rays, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), beams.length_m[beams.on_wall])
    np.testing.assert_allclose(back[:, 2] / np.linalg.norm(back, axis=1), beams.cos_axis[beams.on_wall])


def test_a_level_lidar_sees_the_foot_in_the_middle_and_the_image_right_is_x() -> None:
    rig = _lidar(yaw_deg=0.0)
    beams = cast(rig, rig.pinhole.scaled(81, 65))
    foot = beams.foot_m.reshape(65, 81, 3)
    np.testing.assert_allclose(foot[32, 40], 0, atol=1e-9)
    assert beams.direct.argmax() == 32 * 81 + 40
    assert (np.diff(foot[:, :, 0], axis=1) > 0).all()
    assert (np.diff(foot[:, :, 1], axis=0) < 0).all()


def test_distances_scale_and_s1_falls_with_their_square() -> None:
    near, far = (cast(_lidar(distance_m=d), _cells(BARE)) for d in (0.15, 0.3))
    both = near.on_wall & far.on_wall
    np.testing.assert_allclose(far.length_m[both], 2 * near.length_m[both])
    np.testing.assert_allclose(far.direct[both], near.direct[both] / 4)


@pytest.mark.parametrize("yaw_deg", [75.0, 89.0])
def test_beams_that_meet_nothing_have_no_length_and_no_return(yaw_deg: float) -> None:
    rig = _lidar(yaw_deg=yaw_deg)
    beams = cast(rig, _cells(rig))
    lost = np.isnan(beams.length_m)
    assert lost.any()
    assert not beams.on_wall[lost].any()
    assert (beams.direct[lost] == 0).all()
    assert np.isfinite(beams.direct).all()


def test_beams_beyond_the_walls_edge_meet_nothing() -> None:
    small = BARE.model_copy(update={"wall": Extent(x_min_m=0, x_max_m=0.3, y_min_m=-0.1, y_max_m=0.1)})
    beams = cast(small, _cells(small))
    feet = beams.foot_m[beams.on_wall]
    assert (np.abs(feet - (0.15, 0, 0)) <= (0.15, 0.1, 1e-9)).all()
    assert np.isnan(beams.length_m[~beams.on_wall]).all()


def test_the_occluder_stops_the_beams_that_pass_it_above_its_edge() -> None:
    beams, free = cast(PAPER, _cells(PAPER)), cast(BARE, _cells(BARE))
    stopped = np.isfinite(beams.length_m) & ~beams.on_wall
    assert stopped.any()
    np.testing.assert_allclose(beams.foot_m[stopped, 0], 0.2)
    assert (beams.foot_m[stopped, 2] >= 0.1).all()
    reached = beams.on_wall
    np.testing.assert_allclose(beams.length_m[reached], free.length_m[reached])
    degrees = np.degrees(np.arctan2(beams.foot_m[stopped, 0], 0.2 - beams.foot_m[stopped, 2]))
    assert degrees.min() > 63


def test_an_occluder_behind_the_lidar_stops_nothing() -> None:
    behind = BARE.model_copy(update={"occluder": Occluder(x_m=-3.0, z_min_m=0.05)})
    np.testing.assert_array_equal(cast(behind, _cells(behind)).direct, cast(BARE, _cells(BARE)).direct)


def test_echoes_later_than_the_gate_are_not_received() -> None:
    gate_m = 0.8
    device = BARE.device.model_copy(update={"gate_s": gate_m / SPEED_OF_LIGHT_M_PER_S})
    beams = cast(BARE.model_copy(update={"device": device}), _cells(BARE))
    late = 2 * beams.length_m >= gate_m
    assert 0 < late.sum() < late.size
    assert (beams.direct[late] == 0).all()
    assert (beams.direct[~late] > 0).all()


def test_the_receiver_cell_scales_the_return_and_no_grid_does() -> None:
    device = BARE.device.model_copy(update={"receiver_cell_m2": 3e-4})
    beams = cast(BARE, _cells(BARE))
    np.testing.assert_allclose(cast(BARE.model_copy(update={"device": device}), _cells(BARE)).direct, 3 * beams.direct)
    fine, coarse = cast(BARE, BARE.pinhole.scaled(243, 195)), cast(BARE, BARE.pinhole.scaled(81, 65))
    np.testing.assert_allclose(fine.direct.reshape(195, 243)[1::3, 1::3].ravel(), coarse.direct, rtol=1e-9)
