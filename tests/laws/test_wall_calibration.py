"""What a calibration of the wall must be, whatever the wall: exact enough, repeatable, and never wrong and content."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import angles_from_normal, normal_from_angles, wall_from_plane
from nlos_calibration.noise import DepthMean
from nlos_calibration.plane import fit_plane
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import WallFit, fit_wall, wall_depth

PINHOLE = load_rig("bare-wall").pinhole.scaled(160, 120)
LONGEST_DEPTH_M = 4.0
FRAMES = 8

distances_m = st.floats(0.15, 0.30)
yaws_deg = st.floats(15.0, 70.0) | st.floats(-70.0, -15.0)
pitches_deg = st.floats(-15.0, 15.0)
few = settings(derandomize=True, deadline=None, max_examples=15)


def pose_of(distance_m: float, yaw_deg: float, pitch_deg: float) -> Float64:
    return wall_from_plane(normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m)


def through_sensor(depth_m: Float64, generator: np.random.Generator, dead: float) -> Float64:
    """One frame of `depth_m` as an L515 would give it: noise, steps of 0.25 mm, a limited range, dead pixels."""
    seen = np.where(depth_m < LONGEST_DEPTH_M, depth_m, np.nan)
    noisy = seen + generator.standard_normal(seen.shape) * (0.0005 + 0.002 * seen)
    return np.where(generator.random(seen.shape) < dead, np.nan, np.round(noisy / 0.00025) * 0.00025)


def measured(depth_m: Float64, seed: int = 0, frames: int = FRAMES, dead: float = 0.03) -> WallFit:
    mean, generator = DepthMean(*depth_m.shape), np.random.default_rng(seed)
    for _ in range(frames):
        mean.add(through_sensor(depth_m, generator, dead).astype(np.float32))
    return fit_wall(mean.mean_m(), PINHOLE, generator, mean.noise())


def assert_close(fit: WallFit, distance_m: float, pose: Float64) -> None:
    assert abs(fit.distance_m - distance_m) < 1e-3
    tilt = np.arccos(np.clip(fit.wall_from_lidar[2, :3] @ pose[2, :3], -1.0, 1.0))
    assert np.degrees(tilt) < 0.2


@pytest.mark.parametrize("pitch_deg", [-12.0, 0.0, 8.0])
@pytest.mark.parametrize("yaw_deg", [-45.0, 15.0, 30.0, 45.0, 60.0, 74.0])
@pytest.mark.parametrize("distance_m", [0.15, 0.20, 0.30])
def test_every_wall_of_the_papers_ranges_is_measured(distance_m: float, yaw_deg: float, pitch_deg: float) -> None:
    pose = pose_of(distance_m, yaw_deg, pitch_deg)
    fit = measured(wall_depth(pose, PINHOLE))
    assert_close(fit, distance_m, pose)
    assert fit.verdict == "good"


@few
@given(distances_m, yaws_deg, pitches_deg, st.floats(0.0, 0.3), st.integers(0, 1000))
def test_one_frame_with_dead_pixels_is_enough(
    distance_m: float, yaw_deg: float, pitch_deg: float, dead: float, seed: int
) -> None:
    pose = pose_of(distance_m, yaw_deg, pitch_deg)
    assert_close(measured(wall_depth(pose, PINHOLE), seed, frames=1, dead=dead), distance_m, pose)


@few
@given(distances_m, yaws_deg, pitches_deg, st.floats(0.0, 0.4), st.integers(0, 1000))
def test_outliers_up_to_forty_percent_are_tolerated(
    distance_m: float, yaw_deg: float, pitch_deg: float, share: float, seed: int
) -> None:
    pose, generator = pose_of(distance_m, yaw_deg, pitch_deg), np.random.default_rng(seed)
    depth_m = wall_depth(pose, PINHOLE)
    stray = generator.random(depth_m.shape) < share
    depth_m[stray] = generator.uniform(0.05, 2.0, int(stray.sum()))
    assert_close(measured(depth_m, seed), distance_m, pose)


@few
@given(distances_m, st.floats(-80.0, 80.0), st.floats(-80.0, 80.0))
def test_angles_make_a_pose_and_the_pose_its_angles(distance_m: float, yaw_deg: float, pitch_deg: float) -> None:
    pose = pose_of(distance_m, yaw_deg, pitch_deg)
    assert np.degrees(angles_from_normal(pose[2, :3])) == pytest.approx((yaw_deg, pitch_deg), abs=1e-9)
    np.testing.assert_allclose(wall_from_plane(pose[2, :3], pose[2, 3]), pose, atol=1e-12)


@few
@given(
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(-3.0, 3.0),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.0, 0.1)),
)
def test_a_plane_moves_with_its_points(
    yaw_rad: float, pitch_rad: float, roll_rad: float, shift: tuple[float, ...]
) -> None:
    pose = pose_of(0.2, 20.0, 5.0)
    points = (PINHOLE.scaled(40, 30).rays() * wall_depth(pose, PINHOLE.scaled(40, 30))[..., np.newaxis]).reshape(-1, 3)
    roll = np.array([[np.cos(roll_rad), -np.sin(roll_rad), 0], [np.sin(roll_rad), np.cos(roll_rad), 0], [0, 0, 1]])
    turn = roll @ pose_of(1.0, np.degrees(yaw_rad), np.degrees(pitch_rad))[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    fit = fit_plane(points @ turn.T + shift, np.random.default_rng(0))
    normal = turn @ pose[2, :3]
    np.testing.assert_allclose(fit.normal, normal, atol=1e-6)
    assert fit.distance_m == pytest.approx(0.2 - normal @ shift, abs=1e-6)


def test_the_same_frames_give_the_same_wall() -> None:
    depth_m = wall_depth(pose_of(0.2, 45.0, 0.0), PINHOLE)
    np.testing.assert_array_equal(measured(depth_m).wall_from_lidar, measured(depth_m).wall_from_lidar)


@few
@given(distances_m, st.floats(-60.0, 60.0), st.floats(15.0, 120.0))
def test_two_walls_in_a_corner_are_refused(distance_m: float, yaw_deg: float, bend_deg: float) -> None:
    """The second wall turns `bend_deg` from the first along an edge through the middle of the view."""
    first = wall_depth(pose_of(distance_m, yaw_deg, 0.0), PINHOLE)
    middle_m = first[:, 80:81]
    second = middle_m / (1.0 + np.arange(-80, 80) / PINHOLE.fx * np.tan(np.radians(bend_deg / 2.0 + 8.0)))
    corner = np.where(np.arange(160) < 80, first, np.where(second > 0.0, second, np.nan))
    with pytest.raises(WallRefusedError):
        measured(corner)


def three_bounce_depth(rig_name: str = "paper-rig") -> tuple[Float64, Float64, Float64]:
    """(wall, occluder, three-bounce) depth maps of the paper's rig with a point in the middle of the object box."""
    rig = load_rig(rig_name)
    pose, rays = rig.wall_from_lidar, PINHOLE.rays()
    lidar, directions = pose[:3, 3], rays @ pose[:3, :3].T
    wall_m = wall_depth(pose, PINHOLE)
    along = np.where(directions[..., 0] > 0.0, directions[..., 0], np.nan)
    occluder_m = 0.2 / along
    occluder_m[lidar[2] + occluder_m * directions[..., 2] < 0.1] = np.nan
    seen = np.where(wall_m < LONGEST_DEPTH_M, wall_m, np.nan)
    spots, point = lidar + seen[..., np.newaxis] * directions, np.array([0.45, 0.0, 0.25])
    one_way = np.linalg.norm(spots - lidar, axis=-1) + np.linalg.norm(spots - point, axis=-1)
    shortest_back = 0.3 + 0.35
    binned_m = (np.floor((one_way + shortest_back) / 0.01) + 0.5) * 0.01 / 2.0
    bounced_m = np.where(spots[..., 0] > 0.07, binned_m / np.linalg.norm(rays, axis=-1), np.nan)
    return wall_m, occluder_m, bounced_m


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 1.0])
def test_the_paper_rig_with_a_hidden_object_is_refused(share: float) -> None:
    """`share` of the wall's cells of 8 x 8 pixels that see the box report the three-bounce path."""
    wall_m, occluder_m, bounced_m = three_bounce_depth()
    wins = np.kron(np.random.default_rng(2).random((15, 20)) < share, np.ones((8, 8))) > 0.0
    depth_m = np.where(wins & ~np.isnan(bounced_m), bounced_m, wall_m)
    with pytest.raises(WallRefusedError, match="behind"):
        measured(np.where(np.isnan(occluder_m), depth_m, occluder_m))


def test_a_hidden_object_without_an_occluder_is_refused() -> None:
    wall_m, _, bounced_m = three_bounce_depth()
    wins = np.kron(np.random.default_rng(2).random((15, 20)) < 0.2, np.ones((8, 8))) > 0.0
    with pytest.raises(WallRefusedError, match="behind"):
        measured(np.where(wins & ~np.isnan(bounced_m), bounced_m, wall_m))


def test_an_occluder_without_an_object_is_refused() -> None:
    wall_m, occluder_m, _ = three_bounce_depth()
    with pytest.raises(WallRefusedError, match="in front"):
        measured(np.where(np.isnan(occluder_m), wall_m, occluder_m))
