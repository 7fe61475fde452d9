from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.noise import depth_noise_m
from nlos_calibration.wall import wall_depth
from nlos_calibration.wall_record import MeasuredWall

from nlos_cam.calibrate.report_maps import block_side, expected_std_m, in_blocks, most_of_block, residual_m

Measured = Callable[..., MeasuredWall]
FLOAT32_M = 1e-6


def seen(wall: MeasuredWall, depth_m: np.ndarray, **others: object) -> np.ndarray:
    """The residual of another depth against the wall's record, with other fields."""
    assert wall.reference is not None
    reference = replace(wall.reference, depth_m=depth_m.astype(np.float32))
    return residual_m(wall.record.model_copy(update=others), reference)


@pytest.mark.parametrize(("distance_m", "yaw_deg", "pitch_deg"), [(0.15, 15.0, 0.0), (0.2, -45.0, 10.0), (0.3, 75, -5)])
def test_a_plane_is_on_itself(measured: Measured, distance_m: float, yaw_deg: float, pitch_deg: float) -> None:
    wall = measured(distance_m, yaw_deg, pitch_deg)
    assert wall.reference is not None
    off_m = residual_m(wall.record, wall.reference)
    near = wall.reference.depth_m < 2.0
    assert np.abs(off_m[near]).max() < FLOAT32_M
    assert (np.isnan(off_m) == np.isnan(wall.reference.depth_m)).all()


@pytest.mark.parametrize("bump_m", [0.004, -0.004])
def test_a_bump_is_as_high_as_it_stands_on_the_wall(measured: Measured, bump_m: float) -> None:
    wall = measured(0.2, 40.0, 3.0)
    assert wall.reference is not None
    moved = np.array(wall.record.wall_from_lidar)
    moved[2, 3] += bump_m
    depth_m = wall.reference.depth_m.astype(np.float64)
    depth_m[10:20, 30:40] = wall_depth(moved, wall.reference.intrinsics)[10:20, 30:40]
    off_m = seen(wall, depth_m)
    np.testing.assert_allclose(off_m[10:20, 30:40], bump_m, atol=FLOAT32_M)
    off_m[10:20, 30:40] = 0.0
    assert np.abs(off_m).max() < FLOAT32_M


@pytest.mark.parametrize("offset_m", [0.0045, -0.0045])
def test_an_offset_of_each_depth_is_added(measured: Measured, offset_m: float) -> None:
    wall = measured()
    assert wall.reference is not None
    lacking_m = wall.reference.depth_m.astype(np.float64) - offset_m
    told = {"range_offset_m": offset_m, "range_offset_cause": "depth"}
    assert np.abs(seen(wall, lacking_m, **told)).max() < FLOAT32_M
    assert np.abs(seen(wall, lacking_m)).max() > 0.003


@pytest.mark.parametrize("offset_m", [0.0045, -0.0045])
def test_an_offset_of_the_origin_moves_where_the_beams_meet(measured: Measured, offset_m: float) -> None:
    wall = measured()
    assert wall.reference is not None
    meeting = np.array(wall.record.wall_from_lidar)
    meeting[:3, 3] += offset_m * meeting[:3, 2]
    depth_m = wall_depth(meeting, wall.reference.intrinsics)
    told = {"range_offset_m": offset_m, "range_offset_cause": "origin"}
    assert np.abs(seen(wall, depth_m, **told)).max() < FLOAT32_M
    assert np.abs(seen(wall, depth_m)).max() > 0.003


def test_noise_leaves_what_is_expected(measured: Measured) -> None:
    wall = measured(width=160)
    assert wall.reference is not None
    depth_m = wall.reference.depth_m.astype(np.float64)
    noise_m = depth_noise_m(depth_m) / np.sqrt(wall.reference.frames)
    off_m = seen(wall, depth_m + noise_m * np.random.default_rng(0).standard_normal(depth_m.shape))
    sigmas = off_m / expected_std_m(wall.record, wall.reference)
    assert sigmas.std() == pytest.approx(1.0, abs=0.02)
    left, right = sigmas[:, :40].std(), sigmas[:, -40:].std()
    assert (left, right) == (pytest.approx(1.0, abs=0.04), pytest.approx(1.0, abs=0.04))


@pytest.mark.parametrize(("columns", "side"), [(16, 1), (320, 1), (321, 2), (640, 2), (1024, 4)])
def test_blocks_are_as_large_as_they_must_be(columns: int, side: int) -> None:
    assert block_side(columns) == side


def test_a_block_is_the_mean_of_what_is_known_in_it() -> None:
    values = np.array([[1.0, 3.0, np.nan], [np.nan, 5.0, np.nan], [7.0, 9.0, 11.0]])
    blocks = in_blocks(values, 2)
    np.testing.assert_allclose(blocks, [[3.0, np.nan], [8.0, 11.0]])
    np.testing.assert_array_equal(in_blocks(values, 1), values)


def test_half_of_a_block_is_most_of_it() -> None:
    mask = np.array([[True, True, False, True], [False, False, False, False]])
    assert most_of_block(mask, 2).tolist() == [[True, False]]
