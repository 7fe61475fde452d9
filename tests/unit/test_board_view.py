import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, Corners, find_corners
from nlos_calibration.board_pose import PrintErrors, fit_board
from nlos_calibration.board_wall import (
    EXACT,
    BoardView,
    CameraErrors,
    find_in_view,
    fit_in_lidar,
    plane_in_lidar,
    undistorted,
)
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.wall import measures_of

TOOLS = Path(__file__).parents[2] / "tools"
A4 = BOARDS["a4"]
SLOPES = np.array([1.2, -0.4, 3.5])
POSE = np.eye(4)
POSE[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.3, 0.05]))[0]
POSE[:3, 3] = [0.02, -0.014, 0.007]
NO_PRINT = PrintErrors(0.0, 1e-9, 1e-9)


@pytest.fixture
def colour(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_in_colour")


@pytest.fixture
def corners(colour: ModuleType) -> Corners:
    """Exact, of a board on a wall at 0.25 m, as a colour camera sees them that is as it says."""
    view = importlib.import_module("wall_scenes").view(0.25, 40.0, 5.0, colour.LIDAR)
    bench = colour.Bench(A4, view, importlib.import_module("board_view").at_near_edge(A4, view))
    straight = colour.corners_px(A4, colour.as_told().seen(bench), bench.placed)
    inside = np.flatnonzero(((straight > 0.0) & (straight < [1280.0, 720.0])).all(axis=1))
    return Corners(inside, colour.through_lens(straight[inside]))


def moved(slopes: Float64, pose: Float64 = POSE, errors: CameraErrors = EXACT) -> Float64:
    return plane_in_lidar(slopes, np.zeros((3, 3)), pose, errors)[0]


def numerically(change: Float64, of: object) -> Float64:
    """The derivative of what `of` makes of three small numbers, by central differences."""
    steps = np.eye(3) * 1e-6
    return np.stack([(of(change + step) - of(change - step)) / 2e-6 for step in steps], axis=1)  # type: ignore[operator]


def test_infrared_is_the_lidars_own_view(colour: ModuleType) -> None:
    view = importlib.import_module("wall_scenes").view(0.2, 45.0, 0.0, colour.LIDAR)
    bench = colour.Bench(A4, view, importlib.import_module("board_view").at_near_edge(A4, view))
    image = bench.frames(4, np.random.default_rng(0)).mean(axis=0)
    ours, direct = (
        find_in_view(BoardView(image, colour.LIDAR), A4),
        fit_board(find_corners(image, A4), A4, colour.LIDAR),
    )
    np.testing.assert_allclose(ours.slopes, direct.slopes, rtol=1e-12)
    np.testing.assert_allclose(ours.covariance, direct.covariance, rtol=1e-12)


def test_the_plane_stays_where_it_is() -> None:
    """Points of the plane, in one frame and in the other."""
    rays = np.column_stack([np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2)), np.ones(20)])
    points = rays / (rays @ SLOPES)[:, np.newaxis]
    there = points @ POSE[:3, :3].T + POSE[:3, 3]
    np.testing.assert_allclose(there @ moved(SLOPES), 1.0, rtol=1e-12)


def test_the_covariance_is_moved_as_the_plane_is() -> None:
    by_slopes = numerically(SLOPES, moved)
    root = np.random.default_rng(1).standard_normal((3, 3)) * 1e-3
    covariance = plane_in_lidar(SLOPES, root @ root.T, POSE, EXACT)[1]
    np.testing.assert_allclose(covariance, by_slopes @ root @ root.T @ by_slopes.T, rtol=1e-5, atol=1e-12)


def test_what_the_cameras_pose_does_is_in_the_covariance() -> None:
    def turned(angle: Float64) -> Float64:
        pose = POSE.copy()
        pose[:3, :3] = cv2.Rodrigues(angle)[0] @ POSE[:3, :3]
        return moved(SLOPES, pose)

    def shifted(by_m: Float64) -> Float64:
        pose = POSE.copy()
        pose[:3, 3] += by_m
        return moved(SLOPES, pose)

    by_turn, by_shift = numerically(np.zeros(3), turned), numerically(np.zeros(3), shifted)
    for errors, by, std in (
        (CameraErrors(0.2, 0.0, 0.0), by_turn, np.radians(0.2)),
        (CameraErrors(0.0, 0.0005, 0.0), by_shift, 0.0005),
    ):
        _, covariance = plane_in_lidar(SLOPES, np.zeros((3, 3)), POSE, errors)
        np.testing.assert_allclose(covariance, std**2 * by @ by.T, rtol=1e-5, atol=1e-12)


def test_a_wall_between_camera_and_lidar_is_refused() -> None:
    behind = POSE.copy()
    behind[:3, 3] = POSE[:3, :3] @ (-2.0 * SLOPES / (SLOPES @ SLOPES))
    with pytest.raises(BoardRefusedError, match="between colour camera and lidar"):
        plane_in_lidar(SLOPES, np.zeros((3, 3)), behind, EXACT)


def test_pixels_come_back_through_the_lens(colour: ModuleType) -> None:
    straight = np.random.default_rng(0).uniform([0.0, 0.0], [1280.0, 720.0], (300, 2))
    seen = colour.through_lens(straight)
    assert np.abs(seen - straight).max() > 3.0
    found = undistorted(Corners(np.arange(300), seen), colour.TOLD)
    np.testing.assert_allclose(found.pixels, straight, atol=1e-6)


def test_exact_corners_in_colour_give_the_exact_plane_of_the_lidar(colour: ModuleType, corners: Corners) -> None:
    fit = fit_in_lidar(corners, A4, replace(colour.TOLD, errors=EXACT), NO_PRINT)
    found = measures_of(fit.slopes, fit.covariance)
    assert (found.distance_m, found.yaw_deg, found.pitch_deg) == pytest.approx((0.25, 40.0, 5.0), abs=1e-4)


@pytest.mark.parametrize(
    "change", [{"distortion": np.zeros(5)}, {"lidar_from_camera": np.eye(4)}], ids=["lens", "pose"]
)
def test_lens_and_pose_are_needed(colour: ModuleType, corners: Corners, change: dict[str, Float64]) -> None:
    fit = fit_in_lidar(corners, A4, replace(colour.TOLD, **change), NO_PRINT)
    found = measures_of(fit.slopes, fit.covariance)
    assert abs(found.distance_m - 0.25) > 3.0 * found.distance_std_m


def test_the_cameras_errors_are_most_of_what_is_not_known(colour: ModuleType, corners: Corners) -> None:
    exact, told = (
        measures_of(fit.slopes, fit.covariance)
        for fit in (fit_in_lidar(corners, A4, replace(colour.TOLD, errors=e)) for e in (EXACT, CameraErrors()))
    )
    assert told.yaw_std_deg == pytest.approx(np.hypot(exact.yaw_std_deg, 0.2), rel=0.3)
    assert exact.yaw_std_deg < 0.1 < told.yaw_std_deg
    assert told.distance_std_m > exact.distance_std_m


def test_a_refusal_says_in_what_light_was_looked(colour: ModuleType) -> None:
    with pytest.raises(BoardRefusedError, match="is seen in colour"):
        find_in_view(colour.TOLD, A4)
