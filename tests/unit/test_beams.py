"""The first leg: where beams land, on what, and what S1 returns from there."""

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import Extent, LidarPose, Occluder, Rig, load_rig

from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S, cast, gate_bins

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


def test_rows_of_beams_are_those_of_the_image() -> None:
    beams = cast(PAPER, _cells(PAPER))
    part = beams.of_rows(3, 5)
    assert part.shape == (2, 80)
    np.testing.assert_array_equal(part.foot_m, beams.foot_m[240:400])
    np.testing.assert_array_equal(part.direct, beams.direct[240:400])
    np.testing.assert_array_equal(part.lidar_m, beams.lidar_m)
    assert not beams.without_direct().direct.any()


def test_what_a_beam_meets_on_its_way_takes_the_walls_place() -> None:
    beams = cast(BARE, _cells(BARE))
    met = beams.met(BARE, np.array([7]), np.array([0.1]), np.array([0.5]), np.array([0.25]), 2 * np.pi)
    assert not met.on_wall[7]
    np.testing.assert_allclose(met.foot_m[7], beams.lidar_m + 0.1 * beams.direction[7])
    assert met.direct[7] == pytest.approx(0.25 * 0.5 * 1e-4 / (2 * np.pi * 0.01), rel=0.02)
    others = np.arange(5120) != 7
    np.testing.assert_array_equal(met.direct[others], beams.direct[others])


@pytest.mark.parametrize(("gate_m", "bins"), [(0.999, 100), (1.001, 101), (1e-6, 1)])
def test_the_bins_of_a_gate_begin_inside_it(gate_m: float, bins: int) -> None:
    device = BARE.device.model_copy(update={"gate_s": gate_m / SPEED_OF_LIGHT_M_PER_S})
    assert gate_bins(device) == bins


def test_a_rigs_beams_are_worked_out_once_and_cannot_be_written_into() -> None:
    beams = cast(PAPER, _cells(PAPER))
    assert cast(PAPER, _cells(PAPER)) is beams
    with pytest.raises(ValueError, match="read-only"):
        beams.direct[0] = 1
