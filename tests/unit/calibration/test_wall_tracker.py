from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.reference import BareWall
from nlos_calibration.wall import measures_of, wall_depth
from nlos_calibration.wall_tracker import GRID, WallTrack, noise_scale, watched_pixels
from synthetic_scenes import SMALL, WallPose, reference_of_wall, wall_from_lidar

POSE: WallPose = (0.2, 45.0, -5.0)


@pytest.fixture
def wall() -> BareWall:
    return reference_of_wall(POSE, SMALL, np.random.default_rng(0))


@pytest.fixture
def exact(wall: BareWall) -> BareWall:
    """Without noise in the mean."""
    return replace(wall, depth_m=np.where(wall.inliers, wall_depth(wall_from_lidar(POSE), SMALL), np.nan))


def cells(pixels: np.ndarray) -> np.ndarray:
    rows, columns = np.divmod(pixels, SMALL.width)
    return rows * GRID[0] // SMALL.height * GRID[1] + columns * GRID[1] // SMALL.width


def test_watched_pixels_are_one_of_each_cell(wall: BareWall) -> None:
    pixels = watched_pixels(wall)
    np.testing.assert_array_equal(cells(pixels), np.unique(cells(np.flatnonzero(wall.inliers))))


def test_watched_pixels_leave_out_bad_ones_for_neighbours(wall: BareWall) -> None:
    before, worse = watched_pixels(wall), replace(wall)
    for number, (field, value) in enumerate(
        {"depth_m": np.nan, "depth_std_m": 0.01, "saturated": 0.1, "inliers": False}.items()
    ):
        array = getattr(wall, field).copy()
        array.flat[before[number::4]] = value
        worse = replace(worse, **{field: array})
    after = watched_pixels(worse)
    assert not set(before) & set(after)
    np.testing.assert_array_equal(cells(before), cells(after))


def test_noise_scale_is_that_of_the_reference(wall: BareWall) -> None:
    assert noise_scale(replace(wall, depth_std_m=2.0 * wall.depth_std_m)) == pytest.approx(2.0, rel=0.05)
    single = replace(wall, depth_std_m=np.full_like(wall.depth_std_m, np.nan), frames=1)
    np.testing.assert_array_equal(watched_pixels(single), watched_pixels(wall))
    assert noise_scale(single) == 1.0


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.001, 0.2, -0.2), (-0.004, 1.0, 2.0), (0.03, -6.0, 5.0)])
def test_wall_track_finds_an_exact_pose_exactly(exact: BareWall, shift: WallPose) -> None:
    pose = wall_from_lidar((POSE[0] + shift[0], POSE[1] + shift[1], POSE[2] + shift[2]))
    track, frame, sight = WallTrack(exact, wall_from_lidar(POSE)), wall_depth(pose, SMALL).astype(np.float32), None
    for _ in range(60):
        sight = track.follow(frame)
    now = measures_of(-pose[2, :3] / pose[2, 3], np.zeros((3, 3)))
    assert sight.distance_m == pytest.approx(now.distance_m - POSE[0], abs=2e-6)
    assert sight.yaw_deg == pytest.approx(now.yaw_deg - POSE[1], abs=1e-3)
    assert sight.pitch_deg == pytest.approx(now.pitch_deg - POSE[2], abs=1e-3)
    assert track.share == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("value", [np.nan, 0.0, np.inf, -1.0, 3.0])
def test_wall_track_of_frames_without_the_wall_is_none(wall: BareWall, value: float) -> None:
    track = WallTrack(wall, wall_from_lidar(POSE))
    for _ in range(100):
        assert track.follow(np.full((SMALL.height, SMALL.width), value, np.float32)) is None


def test_wall_track_without_good_pixels_is_none(wall: BareWall) -> None:
    frame = wall.depth_m.copy()
    track = WallTrack(replace(wall, inliers=np.zeros_like(wall.inliers)), wall_from_lidar(POSE))
    assert track.follow(frame) is None
    np.testing.assert_array_equal(frame, wall.depth_m)
