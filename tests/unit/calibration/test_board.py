from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, MIN_CORNERS, Board, Corners, find_corners
from nlos_calibration.board_pose import (
    BoardPose,
    CornerObservations,
    PrintErrors,
    _linear,
    fit_board,
    refine_pose,
    solve_pose,
)
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.geometry import Intrinsics, normal_from_angles, wall_from_plane
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import WallMeasures, measures_of
from pydantic import ValidationError
from synthetic_scenes import Illumination, at_near_edge, clean_infrared, corners_px, infrared_frames
from synthetic_walls import View

PRINT_STD = np.array([0.0035, 0.0003, 0.0003])
TRUE = np.array([0.1, 0.7, 0.05, -0.11, -0.13, 0.30, 0.004, 0.0005, -0.0003])
"""Parameters of an oblique pose of a stretched and bowed print."""
A4 = BOARDS["a4"]
PINHOLE = Intrinsics(640, 480, 457.0, 461.0, 319.5, 239.5)
NORMAL = normal_from_angles(np.radians(45.0), np.radians(5.0))
DISTANCE_M = 0.2
RIG = load_rig("bare-wall")


def of_bench(**light: float) -> tuple[Float64, Float64]:
    """Return the clean infrared of a board on the wall of the rig, and its corners in pixels."""
    seen = View(RIG.wall_from_lidar, RIG.pinhole)
    placed = at_near_edge(A4, seen)
    return clean_infrared(A4, seen, placed, Illumination(**light)), corners_px(A4, seen, placed)


def mean_of(clean: Float64, frames: int = 30) -> Float64:
    return infrared_frames(clean, np.random.default_rng(1), frames).mean(axis=0)


def test_measured_board_is_the_same_board_scaled() -> None:
    board = A4.measured(29.1)

    np.testing.assert_allclose(board.corners_m, 0.97 * A4.corners_m, atol=1e-8)
    assert board.marker_mm / board.square_mm == pytest.approx(0.75)
    np.testing.assert_array_equal(board.pattern(32), A4.pattern(32))


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"marker_mm": 20.0}, "marker_mm"),
        ({"squares_x": 11, "squares_y": 11}, "60"),
        ({"color": "red"}, "color"),
    ],
)
def test_board_that_cannot_exist_is_refused(changed: dict[str, object], problem: str) -> None:
    small = {"squares_x": 4, "squares_y": 5, "square_mm": 20.0, "marker_mm": 15.0}
    with pytest.raises(ValidationError, match=problem):
        Board.model_validate(small | changed)


def test_corners_of_a_well_lit_board_are_found_without_bias() -> None:
    clean, true_px = of_bench()
    found = find_corners(mean_of(clean), A4)
    errors_px = found.pixels - true_px[found.ids]

    assert len(found.ids) >= 25
    assert np.sqrt(np.mean(errors_px**2)) < 0.15
    assert np.abs(np.median(errors_px, axis=0)).max() < 0.1


@pytest.mark.parametrize("counts", [6.0, 600.0])
def test_corners_are_found_at_any_brightness(counts: float) -> None:
    clean, true_px = of_bench(brightest_counts=counts)
    found = find_corners(mean_of(clean), A4)
    errors_px = found.pixels - true_px[found.ids]

    assert len(found.ids) >= 20
    assert np.median(np.linalg.norm(errors_px, axis=1)) < 0.3


@pytest.mark.slow
def test_find_corners_needs_the_mean_of_dim_frames() -> None:
    frames = infrared_frames(of_bench(brightest_counts=3.0)[0], np.random.default_rng(1), 60)
    with pytest.raises(BoardRefusedError):
        find_corners(frames[0], A4)

    assert len(find_corners(frames.mean(axis=0), A4).ids) >= 16


@pytest.mark.parametrize("value", [0, 17, 255])
def test_find_corners_without_a_board_advises_on_the_light(value: int) -> None:
    blank = np.full((480, 640), value, np.uint8)
    with pytest.raises(BoardRefusedError, match="toner"):
        find_corners(blank, A4)


def test_mirrored_board_is_refused() -> None:
    clean, _ = of_bench()
    mirrored = clean[:, ::-1] + np.random.default_rng(0).normal(0.0, 0.1, clean.shape)
    with pytest.raises(BoardRefusedError, match="mirrored"):
        find_corners(mirrored, A4)


def test_board_mostly_out_of_view_is_refused_with_its_corners() -> None:
    hidden = mean_of(of_bench()[0])
    hidden[:, 150:] = 0.0
    with pytest.raises(BoardRefusedError, match=rf"^\d corners .*{MIN_CORNERS} "):
        find_corners(hidden, A4)


def test_board_of_another_dictionary_is_refused() -> None:
    clean, _ = of_bench()
    other = BOARDS["a3"].model_copy(update={"dictionary": "DICT_4X4_250", "squares_x": 5})
    with pytest.raises(BoardRefusedError):
        find_corners(clean, other)


def seen_of(
    parameters: Float64, sigma_px: float, generator: np.random.Generator
) -> CornerObservations:
    """Return the corners of a print with these nine parameters, with noise."""
    drawn = CornerObservations(
        points_m=A4.corners_m,
        pixels=np.zeros((40, 2)),
        camera=PINHOLE.matrix,
        size_m=np.array(A4.size_mm) * 1e-3,
        print_std=PRINT_STD,
        variance_px2=max(sigma_px, 1e-3) ** 2,
    )
    _, errors = _linear(drawn, parameters)
    pixels = -errors[:-3].reshape(-1, 2) * np.sqrt(drawn.variance_px2)
    return replace(drawn, pixels=pixels + sigma_px * generator.standard_normal(pixels.shape))


def projected(
    points_m: Float64, distance_m: float = DISTANCE_M, normal: Float64 = NORMAL
) -> Float64:
    """Return the pixels of points (n, 3) of a board on the wall (z points into the wall)."""
    right, up, _ = wall_from_plane(normal, distance_m)[:3, :3]
    middle_m = 0.8 * distance_m / -normal[2] * np.array([0.0, 0.0, 1.0])
    middle_m -= (middle_m @ normal + distance_m) * normal
    x_m, y_m, z_m = (points_m - [0.09, 0.135, 0.0]).T
    at = middle_m + np.outer(x_m, right) - np.outer(y_m, up) - np.outer(z_m, normal)
    seen = at @ PINHOLE.matrix.T
    return seen[:, :2] / seen[:, 2:]


def corners(
    points_m: Float64 | None = None, sigma_px: float = 0.05, seed: int = 0, **where: float
) -> Corners:
    pixels = projected(A4.corners_m if points_m is None else points_m, **where)
    noise_px = sigma_px * np.random.default_rng(seed).standard_normal(pixels.shape)
    return Corners(np.arange(len(pixels)), pixels + noise_px)


def bowed(height_m: float) -> Float64:
    across = 2.0 * A4.corners_m[:, 0] / 0.18 - 1.0
    return A4.corners_m - np.outer(height_m * (1.0 - across**2), [0.0, 0.0, 1.0])


def measures(found: Corners, board: Board = A4, **fit: Any) -> WallMeasures:
    plane = fit_board(found, board, PINHOLE, **fit)
    return measures_of(plane.slopes, plane.covariance)


def test_solve_pose_finds_stretch_and_bows() -> None:
    pose = solve_pose(seen_of(TRUE, 0.02, np.random.default_rng(0)))
    assert (np.abs(pose.parameters[6:] - TRUE[6:]) < [5e-4, 1e-4, 1e-4]).all()


def test_solve_pose_refuses_two_poses_that_fit_equally_well() -> None:
    far = np.array([0.0, 0.35, 0.0, -0.09, -0.135, 4.0, 0.0, 0.0, 0.0])
    with pytest.raises(BoardRefusedError, match=r"\d+ degrees"):
        solve_pose(seen_of(far, 0.5, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def refined() -> BoardPose:
    return refine_pose(seen_of(TRUE, 0.1, np.random.default_rng(0)), TRUE)


def test_slopes_are_those_of_the_boards_plane(refined: BoardPose) -> None:
    rotation = cv2.Rodrigues(refined.parameters[:3])[0]
    point_m = rotation @ [0.1, 0.2, 0.0] + refined.parameters[3:6]
    slopes, _ = refined.slopes()

    assert slopes @ point_m == pytest.approx(1.0)


def test_slopes_have_the_poses_covariance_by_their_derivatives(refined: BoardPose) -> None:
    slopes, covariance = refined.slopes()
    step = 1e-7
    by_pose = np.zeros((3, 6))
    for k in range(6):
        moved = replace(refined, parameters=refined.parameters + step * np.eye(9)[k])
        by_pose[:, k] = (moved.slopes()[0] - slopes) / step
    expected = by_pose @ refined.covariance[:6, :6] @ by_pose.T

    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-8)


def test_fit_board_of_exact_corners_is_exact() -> None:
    fit = fit_board(corners(sigma_px=0.0), A4, PINHOLE)

    np.testing.assert_allclose(fit.slopes, -NORMAL / DISTANCE_M, rtol=1e-6)
    assert fit.corners == 40
    assert fit.residual_px < 1e-6
    assert (fit.stretch, fit.bow_m) == pytest.approx((0.0, 0.0), abs=1e-7)


def test_fit_board_covariance_grows_with_the_residuals() -> None:
    flat = PrintErrors(1e-9, 1e-9, 1e-9)
    quiet = fit_board(corners(sigma_px=0.05), A4, PINHOLE, flat)
    loud = fit_board(corners(sigma_px=0.2), A4, PINHOLE, flat)

    assert loud.residual_px == pytest.approx(0.2, rel=0.3)
    np.testing.assert_allclose(loud.covariance, 16.0 * quiet.covariance, rtol=0.3, atol=1e-7)


def test_fit_board_leaves_out_corners_far_off() -> None:
    found = corners()
    found.pixels[[3, 17, 30]] += [[4.0, 1.0], [-2.0, 2.0], [20.0, -30.0]]

    assert fit_board(found, A4, PINHOLE).corners == 37

    wall = measures(found)

    assert wall.distance_m == pytest.approx(DISTANCE_M, abs=4 * wall.distance_std_m)
    assert wall.yaw_deg == pytest.approx(45.0, abs=4 * wall.yaw_std_deg)


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_fit_board_of_a_scaled_print_shifts_only_the_distance(scale: float) -> None:
    found = corners(scale * A4.corners_m)
    wall = measures(found)

    assert wall.distance_m == pytest.approx(DISTANCE_M / scale, rel=0.01)
    assert wall.yaw_deg == pytest.approx(45.0, abs=0.2)

    measured = measures(found, A4.measured(30.0 * scale))

    assert measured.distance_m == pytest.approx(DISTANCE_M, rel=0.003)


def test_fit_board_scale_uncertainty_is_one_of_the_distance() -> None:
    exact = measures(corners(), printed=PrintErrors(scale_std=0.0))
    ruled = measures(corners(), printed=PrintErrors(scale_std=0.01))
    expected_m = np.hypot(exact.distance_std_m, 0.01 * exact.distance_m)

    assert ruled.distance_std_m == pytest.approx(expected_m)
    assert ruled.yaw_std_deg == pytest.approx(exact.yaw_std_deg)


@pytest.mark.parametrize(
    "points_m",
    [
        A4.corners_m * [1.03, 1.0, 1.0],
        A4.corners_m @ np.array([[1.0, 0.0, 0.0], [0.02, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        bowed(0.004),
        bowed(0.03),
        A4.corners_m + np.random.default_rng(0).normal(0.0, 0.0015, (40, 1)) * [0.0, 0.0, 1.0],
    ],
    ids=["stretched", "skewed", "bowed", "rolled", "crumpled"],
)
def test_fit_board_refuses_a_print_out_of_shape(points_m: Float64) -> None:
    with pytest.raises(BoardRefusedError):
        fit_board(corners(points_m, sigma_px=0.03), A4, PINHOLE)


def test_fit_board_refuses_wrong_intrinsics() -> None:
    with pytest.raises(BoardRefusedError):
        fit_board(corners(), A4, Intrinsics(640, 480, 457.0, 520.0, 300.0, 200.0))


def test_fit_board_refuses_corners_in_one_column() -> None:
    found = corners()
    column = found.ids % 5 == 2
    with pytest.raises(BoardRefusedError):
        fit_board(Corners(found.ids[column], found.pixels[column]), A4, PINHOLE)


def noise_px() -> Float64:
    return np.random.default_rng(0).standard_normal((40, 2))


def test_fit_board_refuses_a_board_edge_on() -> None:
    pixels = projected(A4.corners_m, 0.02, normal_from_angles(np.radians(89.0), 0.0))
    with pytest.raises(BoardRefusedError):
        fit_board(Corners(np.arange(40), pixels + 0.2 * noise_px()), A4, PINHOLE)


@pytest.mark.parametrize("yaw_deg", [92.0, 100.0])
def test_fit_board_refuses_a_board_beside_the_optical_axis(yaw_deg: float) -> None:
    right, up, normal = wall_from_plane(normal_from_angles(np.radians(yaw_deg), 0.0), 0.1)[:3, :3]
    x_m, y_m, _ = (A4.corners_m - [0.09, 0.135, 0.0]).T
    at_m = 0.25 * np.array([-0.7, 0.0, 1.0]) + np.outer(x_m, right) - np.outer(y_m, up)
    pixels = (at_m @ PINHOLE.matrix.T)[:, :2] / at_m[:, 2:]

    assert np.all(at_m[:, 2] > 0.0)
    assert np.all(at_m @ normal < 0.0)  # its printed side is towards the lidar
    with pytest.raises(BoardRefusedError, match="optical axis"):
        fit_board(Corners(np.arange(40), pixels + 0.05 * noise_px()), A4, PINHOLE)


def test_fit_board_refuses_a_tiny_board_far_away() -> None:
    tiny = A4.measured(1.0)
    middle_m = np.array([0.0875, 0.131, 0.0])
    pixels = projected(tiny.corners_m + middle_m, 0.4, normal_from_angles(0.5, 0.0))
    with pytest.raises(BoardRefusedError):
        fit_board(Corners(np.arange(40), pixels + 0.05 * noise_px()), tiny, PINHOLE)


@pytest.mark.parametrize("kind", ["scattered", "in a line", "mirrored", "in a heap"])
def test_fit_board_refuses_random_corners_of_any_number(kind: str) -> None:
    generator = np.random.default_rng(0)
    for count in range(8, 41):
        ids = np.sort(generator.choice(40, count, replace=False))
        x_m, y_m, _ = A4.corners_m[ids].T
        pixels = {
            "scattered": generator.uniform(0.0, 480.0, (count, 2)),
            "in a line": np.column_stack([2000.0 * x_m, np.full(count, 50.0)]),
            "mirrored": np.column_stack([400.0 - 1500.0 * x_m, 1500.0 * y_m]),
            "in a heap": np.full((count, 2), 100.0),
        }[kind]
        with pytest.raises(BoardRefusedError):
            fit_board(Corners(ids, pixels + generator.normal(0.0, 0.05, (count, 2))), A4, PINHOLE)
