"""A calibrated wall is accurate and repeatable for any wall, and never wrong without a warning."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import WallFit, load_rig, wall_depth
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.plane import fit_depth
from numpy.typing import NDArray
from synthetic_walls import PINHOLE, View, measured, view

LONGEST_DEPTH_M = 4.0
distances_m = st.floats(0.15, 0.30)
yaws_deg = st.floats(15.0, 70.0) | st.floats(-70.0, -15.0)
pitches_deg = st.floats(-15.0, 15.0)
few = settings(derandomize=True, deadline=None, max_examples=15)


def assert_close(fit: WallFit, wall: View) -> None:
    assert abs(fit.distance_m - wall.pose[2, 3]) < 1e-3
    tilt = np.arccos(np.clip(fit.wall_from_lidar[2, :3] @ wall.pose[2, :3], -1.0, 1.0))
    assert np.degrees(tilt) < 0.2


@pytest.mark.parametrize("pitch_deg", [-12.0, 0.0, 8.0])
@pytest.mark.parametrize("yaw_deg", [-45.0, 15.0, 30.0, 45.0, 60.0, 74.0])
@pytest.mark.parametrize("distance_m", [0.15, 0.20, 0.30])
def test_wall_fit_measures_every_wall_of_the_papers_ranges(
    distance_m: float, yaw_deg: float, pitch_deg: float
) -> None:
    wall = view(distance_m, yaw_deg, pitch_deg, PINHOLE)
    fit = measured(wall.depth_m)
    again = measured(wall.depth_m)

    assert_close(fit, wall)
    assert fit.verdict == "good"
    np.testing.assert_array_equal(again.wall_from_lidar, fit.wall_from_lidar)


@few
@given(distances_m, yaws_deg, pitches_deg, st.floats(0.0, 0.3), st.integers(0, 1000))
def test_wall_fit_needs_one_frame_even_with_dead_pixels(
    distance_m: float, yaw_deg: float, pitch_deg: float, dead: float, seed: int
) -> None:
    wall = view(distance_m, yaw_deg, pitch_deg, PINHOLE)
    alive = np.random.default_rng(seed).random(wall.depth_m.shape) >= dead

    assert_close(measured(np.where(alive, wall.depth_m, np.nan), seed, frames=1), wall)


@few
@given(distances_m, yaws_deg, pitches_deg, st.floats(0.0, 0.4), st.integers(0, 1000))
def test_wall_fit_allows_outliers(
    distance_m: float, yaw_deg: float, pitch_deg: float, share: float, seed: int
) -> None:
    wall = view(distance_m, yaw_deg, pitch_deg, PINHOLE)
    generator = np.random.default_rng(seed)
    stray = generator.random(wall.depth_m.shape) < share  # also where no wall is met
    anything_m = generator.uniform(0.05, 2.0, wall.depth_m.shape)

    assert_close(measured(np.where(stray, anything_m, wall.depth_m), seed), wall)


@few
@given(
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(-3.0, 3.0),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.0, 0.1)),
)
def test_fit_moves_with_its_points(
    yaw_rad: float, pitch_rad: float, roll_rad: float, shift: tuple[float, ...]
) -> None:
    pinhole = PINHOLE.scaled(40, 30)
    wall = view(0.2, 20.0, 5.0, pinhole)
    points = (pinhole.rays() * wall.depth_m[..., np.newaxis]).reshape(-1, 3)
    turn = cv2.Rodrigues(np.array([pitch_rad, yaw_rad, 0.0]))[0]
    turn = cv2.Rodrigues(np.array([0.0, 0.0, roll_rad]))[0] @ turn

    points = points @ turn.T + shift
    fit = fit_depth(points / points[:, 2:], points[:, 2], np.random.default_rng(0))
    normal = turn @ wall.pose[2, :3]

    np.testing.assert_allclose(fit.normal, normal, atol=1e-6)
    assert fit.distance_m == pytest.approx(0.2 - normal @ shift, abs=1e-6)


@few
@given(distances_m, st.floats(-60.0, 60.0), st.floats(15.0, 120.0))
def test_two_walls_in_a_corner_are_refused(
    distance_m: float, yaw_deg: float, bend_deg: float
) -> None:
    """The second wall turns from the first along an edge through the middle of the view."""
    first_m = view(distance_m, yaw_deg, 0.0, PINHOLE).depth_m
    column = np.arange(160) - 80
    slope = np.tan(np.radians(bend_deg / 2.0 + 8.0)) / PINHOLE.fx
    second_m = first_m[:, 80:81] / (1.0 + column * slope)
    second_m = np.where(second_m > 0.0, second_m, np.nan)
    with pytest.raises(WallRefusedError):
        measured(np.where(column < 0, first_m, second_m))


@dataclass(frozen=True)
class PaperBench:
    """Depths of the paper's rig by each of its paths; NaN where a beam does not take it."""

    wall_m: Float64
    occluder_m: Float64
    bounced_m: Float64
    """By way of a point in the object box."""

    def with_object(self, share: float) -> Float64:
        """Return the wall's depth, in a share of the cells that of the path by the object."""
        bounced = cells_won(share) & ~np.isnan(self.bounced_m)
        return np.where(bounced, self.bounced_m, self.wall_m)

    def with_occluder(self, depth_m: Float64) -> Float64:
        return np.where(np.isnan(self.occluder_m), depth_m, self.occluder_m)


@pytest.fixture(scope="module")
def bench() -> PaperBench:
    pose = load_rig("paper-rig").wall_from_lidar
    lidar = pose[:3, 3]
    rays = PINHOLE.rays()
    directions = rays @ pose[:3, :3].T
    wall_m = wall_depth(pose, PINHOLE)

    occluder_m = 0.2 / np.where(directions[..., 0] > 0.0, directions[..., 0], np.nan)
    occluder_m[lidar[2] + occluder_m * directions[..., 2] < 0.1] = np.nan

    seen_m = np.where(wall_m < LONGEST_DEPTH_M, wall_m, np.nan)
    spots = lidar + seen_m[..., np.newaxis] * directions
    point = np.array([0.45, 0.0, 0.25])
    out_m = np.linalg.norm(spots - lidar, axis=-1) + np.linalg.norm(spots - point, axis=-1)
    shortest_back_m = 0.3 + 0.35
    binned_m = (np.floor((out_m + shortest_back_m) / 0.01) + 0.5) * 0.01 / 2.0
    bounced_m = np.where(spots[..., 0] > 0.07, binned_m / np.linalg.norm(rays, axis=-1), np.nan)
    return PaperBench(wall_m, occluder_m, bounced_m)


def cells_won(share: float) -> NDArray[np.bool_]:
    """Return random cells of 8 x 8 pixels that report the three-bounce path, as a share of all."""
    won = np.random.default_rng(2).random((15, 20)) < share
    return np.kron(won, np.ones((8, 8))) > 0.0


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 1.0])
def test_object_behind_an_occluder_is_refused(bench: PaperBench, share: float) -> None:
    with pytest.raises(WallRefusedError, match="behind"):
        measured(bench.with_occluder(bench.with_object(share)))


def test_hidden_object_alone_is_refused(bench: PaperBench) -> None:
    with pytest.raises(WallRefusedError, match="behind"):
        measured(bench.with_object(0.2))


def test_occluder_alone_is_refused(bench: PaperBench) -> None:
    with pytest.raises(WallRefusedError, match="in front"):
        measured(bench.with_occluder(bench.wall_m))
