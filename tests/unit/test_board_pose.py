from dataclasses import replace

import cv2
import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS
from nlos_calibration.board_pose import SeenCorners, _linear, refine_pose, solve_pose
from nlos_calibration.errors import BoardRefusedError

A4 = BOARDS["a4"]
CAMERA = np.array([[457.0, 0.0, 319.5], [0.0, 461.0, 239.5], [0.0, 0.0, 1.0]])
PRINT_STD = np.array([0.0035, 0.0003, 0.0003])
TRUE = np.array([0.1, 0.7, 0.05, -0.11, -0.13, 0.30, 0.004, 0.0005, -0.0003])
"""An oblique pose of a stretched and bowed print."""


def seen_of(parameters: Float64, sigma_px: float, generator: np.random.Generator) -> SeenCorners:
    drawn = SeenCorners(
        A4.corners_m,
        np.zeros((len(A4.corners_m), 2)),
        CAMERA,
        np.array(A4.size_mm) * 1e-3,
        PRINT_STD,
        max(sigma_px, 1e-3) ** 2,
    )
    pixels = -_linear(drawn, parameters)[1][:-3].reshape(-1, 2) * np.sqrt(drawn.variance_px2)
    return replace(drawn, pixels=pixels + sigma_px * generator.standard_normal(pixels.shape))


def test_the_model_of_a_flat_print_is_opencvs_projection() -> None:
    flat = np.append(TRUE[:6], np.zeros(3))
    expected = cv2.projectPoints(A4.corners_m, flat[:3], flat[3:6], CAMERA, None)[0].reshape(-1, 2)
    np.testing.assert_allclose(seen_of(flat, 0.0, np.random.default_rng(0)).pixels, expected, atol=1e-9)


def test_a_stretch_widens_and_a_bow_comes_towards_the_lidar() -> None:
    front = np.array([0.0, 0.0, 0.0, -0.09, -0.135, 0.3, 0.0, 0.0, 0.0])
    flat, wide, bowed = (
        seen_of(front + change, 0.0, np.random.default_rng(0)).pixels
        for change in (np.zeros(9), 0.01 * np.eye(9)[6], 0.001 * np.eye(9)[7])
    )
    assert np.ptp(wide[:, 0]) / np.ptp(flat[:, 0]) == pytest.approx(np.exp(0.005))
    assert np.ptp(wide[:, 1]) / np.ptp(flat[:, 1]) == pytest.approx(np.exp(-0.005))
    assert np.ptp(bowed[:, 1]) > np.ptp(flat[:, 1])  # the middle of the sheet is nearer, so it looks larger


def test_derivatives_are_those_of_the_model() -> None:
    seen = seen_of(TRUE, 0.1, np.random.default_rng(0))
    rows, errors = _linear(seen, TRUE)
    step = 1e-6
    for k in range(9):
        moved = _linear(seen, TRUE + step * np.eye(9)[k])[1]
        np.testing.assert_allclose((errors - moved) / step, rows[:, k], rtol=1e-4, atol=1e-3 * np.abs(rows[:, k]).max())


def test_exact_corners_of_a_flat_print_give_the_exact_pose() -> None:
    flat = np.append(TRUE[:6], np.zeros(3))
    pose = solve_pose(seen_of(flat, 0.0, np.random.default_rng(0)))
    np.testing.assert_allclose(pose.parameters, flat, atol=1e-8)
    np.testing.assert_allclose(pose.errors_px, 0.0, atol=1e-6)


def test_stretch_and_bows_are_found_where_the_corners_show_them() -> None:
    pose = solve_pose(seen_of(TRUE, 0.02, np.random.default_rng(0)))
    assert (np.abs(pose.parameters[6:] - TRUE[6:]) < [5e-4, 1e-4, 1e-4]).all()


def test_the_covariance_is_the_spread_of_what_is_found() -> None:
    generator, found = np.random.default_rng(3), []
    for _ in range(200):
        how = np.append(TRUE[:6], PRINT_STD * generator.standard_normal(3))
        pose = solve_pose(seen_of(how, 0.1, generator))
        off = pose.parameters - how
        found.append(off @ np.linalg.solve(pose.covariance, off))
    assert np.mean(found) == pytest.approx(9.0, abs=4.0 * np.sqrt(2.0 * 9.0 / 200))


def test_slopes_and_their_covariance_are_the_planes() -> None:
    pose = refine_pose(seen_of(TRUE, 0.1, np.random.default_rng(0)), TRUE)
    slopes, covariance = pose.slopes()
    corner_m = cv2.Rodrigues(pose.parameters[:3])[0] @ [0.1, 0.2, 0.0] + pose.parameters[3:6]
    assert slopes @ corner_m == pytest.approx(1.0)  # points p of the plane have slopes . p = 1
    step, by_pose = 1e-7, np.zeros((3, 6))
    for k in range(6):
        by_pose[:, k] = (replace(pose, parameters=pose.parameters + step * np.eye(9)[k]).slopes()[0] - slopes) / step
    np.testing.assert_allclose(covariance, by_pose @ pose.covariance[:6, :6] @ by_pose.T, rtol=1e-4, atol=1e-8)


def test_two_poses_that_explain_the_board_alike_are_refused() -> None:
    far = np.array([0.0, 0.35, 0.0, -0.09, -0.135, 4.0, 0.0, 0.0, 0.0])
    with pytest.raises(BoardRefusedError, match=r"two poses, \d+ degrees apart"):
        solve_pose(seen_of(far, 0.5, np.random.default_rng(0)))
