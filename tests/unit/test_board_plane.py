from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, Corners
from nlos_calibration.board_pose import PrintErrors, fit_board
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.geometry import Intrinsics, normal_from_angles
from nlos_calibration.wall import measures_of

A4 = BOARDS["a4"]
PINHOLE = Intrinsics(640, 480, 457.0, 461.0, 319.5, 239.5)
NORMAL, DISTANCE_M = normal_from_angles(np.radians(45.0), np.radians(5.0)), 0.2


def seen(points_m: Float64, distance_m: float = DISTANCE_M, normal: Float64 = NORMAL) -> Float64:
    """Pixels of points (n, 3) of a board on the wall, z into the wall, its middle a little short of the axis."""
    right = np.cross([0.0, 1.0, 0.0], -normal)
    right /= np.linalg.norm(right)
    down = np.cross(-normal, right)
    middle_m = 0.8 * distance_m / -normal[2] * np.array([0.0, 0.0, 1.0])
    middle_m -= (middle_m @ normal + distance_m) * normal
    x_m, y_m, z_m = (points_m - [0.09, 0.135, 0.0]).T
    at = middle_m + np.outer(x_m, right) + np.outer(y_m, down) - np.outer(z_m, normal)
    return np.column_stack(
        [at[:, 0] / at[:, 2] * PINHOLE.fx + PINHOLE.ppx, at[:, 1] / at[:, 2] * PINHOLE.fy + PINHOLE.ppy]
    )


def corners(points_m: Float64 | None = None, sigma_px: float = 0.05, seed: int = 0, **where: float) -> Corners:
    pixels = seen(A4.corners_m if points_m is None else points_m, **where)
    return Corners(
        np.arange(len(pixels)), pixels + sigma_px * np.random.default_rng(seed).standard_normal(pixels.shape)
    )


def test_exact_corners_give_the_exact_plane() -> None:
    fit = fit_board(corners(sigma_px=0.0), A4, PINHOLE)
    np.testing.assert_allclose(fit.slopes, -NORMAL / DISTANCE_M, rtol=1e-6)
    assert fit.corners == 40
    assert fit.residual_px < 1e-6
    assert (fit.stretch, fit.bow_m) == pytest.approx((0.0, 0.0), abs=1e-7)


def test_noise_is_told_by_the_residuals_and_widens_the_covariance() -> None:
    quiet, loud = (
        fit_board(corners(sigma_px=sigma), A4, PINHOLE, PrintErrors(1e-9, 1e-9, 1e-9)) for sigma in (0.05, 0.2)
    )
    assert loud.residual_px == pytest.approx(0.2, rel=0.3)
    np.testing.assert_allclose(loud.covariance, 16.0 * quiet.covariance, rtol=0.3, atol=1e-7)


def test_corners_far_off_are_left_out() -> None:
    found = corners()
    found.pixels[[3, 17, 30]] += [[4.0, 1.0], [-2.0, 2.0], [20.0, -30.0]]
    fit = fit_board(found, A4, PINHOLE)
    assert fit.corners == 37
    measures = measures_of(fit.slopes, fit.covariance)
    assert measures.distance_m == pytest.approx(DISTANCE_M, abs=4 * measures.distance_std_m)
    assert measures.yaw_deg == pytest.approx(45.0, abs=4 * measures.yaw_std_deg)


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_a_print_of_another_scale_shifts_the_distance_and_nothing_shows_it(scale: float) -> None:
    measures = [
        measures_of(fit.slopes, fit.covariance)
        for fit in (fit_board(corners(points), A4, PINHOLE) for points in (A4.corners_m, scale * A4.corners_m))
    ]
    assert measures[1].distance_m == pytest.approx(DISTANCE_M / scale, rel=0.01)
    assert measures[1].yaw_deg == pytest.approx(45.0, abs=0.2)
    by_ruler = fit_board(corners(scale * A4.corners_m), A4.measured(30.0 * scale), PINHOLE)
    assert 1.0 / np.linalg.norm(by_ruler.slopes) == pytest.approx(DISTANCE_M, rel=0.003)


def test_the_scales_uncertainty_is_one_of_the_distance_alone() -> None:
    exact, ruled = (
        measures_of(fit.slopes, fit.covariance)
        for fit in (fit_board(corners(), A4, PINHOLE, PrintErrors(scale_std=std)) for std in (0.0, 0.01))
    )
    assert ruled.distance_std_m == pytest.approx(np.hypot(exact.distance_std_m, 0.01 * exact.distance_m))
    assert ruled.yaw_std_deg == pytest.approx(exact.yaw_std_deg)


def test_a_focal_length_that_is_off_moves_the_plane_as_far_as_its_uncertainty_says() -> None:
    exact, unsure = (fit_board(corners(sigma_px=0.0), A4, PINHOLE, focal_std=std) for std in (0.0, 1e-4))
    longer = replace(PINHOLE, fx=PINHOLE.fx * 1.0001, fy=PINHOLE.fy * 1.0001)
    change = fit_board(corners(sigma_px=0.0), A4, longer).slopes - exact.slopes
    np.testing.assert_allclose(unsure.covariance - exact.covariance, np.outer(change, change), rtol=0.02, atol=1e-11)
    assert np.linalg.norm(change) > 1e-5


@pytest.mark.parametrize("stretch", [-0.01, 0.005])
def test_a_stretched_print_does_not_turn_the_wall(stretch: float) -> None:
    points_m = A4.corners_m * [1.0 + stretch, 1.0, 1.0]
    fit = fit_board(corners(points_m), A4, PINHOLE)
    measures = measures_of(fit.slopes, fit.covariance)
    assert fit.stretch == pytest.approx(stretch, abs=0.001)
    assert measures.yaw_deg == pytest.approx(45.0, abs=0.1)


def bowed(height_m: float) -> Float64:
    across = 2.0 * A4.corners_m[:, 0] / 0.18 - 1.0
    return A4.corners_m - np.outer(height_m * (1.0 - across**2), [0.0, 0.0, 1.0])


def test_a_sheet_that_bows_a_little_is_seen_through() -> None:
    fit = fit_board(corners(bowed(0.0005)), A4, PINHOLE)
    measures = measures_of(fit.slopes, fit.covariance)
    assert fit.bow_m == pytest.approx(0.0005, abs=0.0002)
    assert measures.distance_m == pytest.approx(DISTANCE_M, abs=4 * measures.distance_std_m)


@pytest.mark.parametrize(
    ("points_m", "problem"),
    [
        (A4.corners_m * [1.03, 1.0, 1.0], "squares do not fit"),
        (A4.corners_m @ np.array([[1.0, 0.0, 0.0], [0.02, 1.0, 0.0], [0.0, 0.0, 1.0]]), "squares do not fit"),
        (bowed(0.004), "not flat|do not fit"),
        (bowed(0.03), "not flat|lie on one plane"),
    ],
    ids=["stretched", "skewed", "bowed", "rolled"],
)
def test_a_print_that_is_not_flat_or_not_to_proportion_is_refused(points_m: Float64, problem: str) -> None:
    with pytest.raises(BoardRefusedError, match=problem):
        fit_board(corners(points_m, sigma_px=0.03), A4, PINHOLE)


def test_a_crumpled_board_is_refused() -> None:
    crumpled = A4.corners_m + np.random.default_rng(0).normal(0.0, 0.0015, (40, 1)) * [0.0, 0.0, 1.0]
    with pytest.raises(BoardRefusedError, match="not flat"):
        fit_board(corners(crumpled), A4, PINHOLE)


def test_the_intrinsics_of_another_camera_are_noticed() -> None:
    wrong = Intrinsics(640, 480, 457.0, 520.0, 300.0, 200.0)
    with pytest.raises(BoardRefusedError, match="squares do not fit"):
        fit_board(corners(), A4, wrong)


def test_corners_in_a_line_are_refused() -> None:
    line = corners()
    column = line.ids % 5 == 2
    with pytest.raises(BoardRefusedError, match=r"in a line|one plane"):
        fit_board(Corners(line.ids[column], line.pixels[column]), A4, PINHOLE)


def test_a_board_seen_edge_on_is_refused() -> None:
    edge_on = normal_from_angles(np.radians(89.0), 0.0)
    pixels = seen(A4.corners_m, 0.02, edge_on)
    pixels += 0.2 * np.random.default_rng(0).standard_normal(pixels.shape)
    with pytest.raises(BoardRefusedError):
        fit_board(Corners(np.arange(40), pixels), A4, PINHOLE)


def test_a_board_far_away_says_too_little() -> None:
    small = A4.measured(1.0)
    far = seen(small.corners_m + np.array([0.0875, 0.131, 0.0]), 0.4, normal_from_angles(0.5, 0.0))
    far += 0.05 * np.random.default_rng(0).standard_normal(far.shape)
    with pytest.raises(BoardRefusedError, match=r"two poses|degrees only"):
        fit_board(Corners(np.arange(40), far), small, PINHOLE)


def test_the_same_corners_give_the_same_plane() -> None:
    one, other = (fit_board(corners(sigma_px=0.2), A4, PINHOLE) for _ in range(2))
    np.testing.assert_array_equal(one.slopes, other.slopes)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_few_corners_are_less_sure() -> None:
    found = corners(sigma_px=0.1)
    few = np.isin(found.ids, [0, 1, 2, 5, 6, 7, 10, 11, 12])
    all_of_them, some = (fit_board(which, A4, PINHOLE) for which in (found, Corners(found.ids[few], found.pixels[few])))
    assert np.trace(some.covariance) > 4.0 * np.trace(all_of_them.covariance)


@pytest.mark.parametrize("kind", ["scattered", "in a line", "mirrored", "in a heap"])
def test_corners_that_are_no_boards_are_refused_whatever_their_number(kind: str) -> None:
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
