from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from board_trials import CALIBRATION, ColorCamera, bench_at, through_lens
from nlos_calibration import (
    BOARDS,
    Corners,
    Light,
    PrintErrors,
    board_wall,
    load_rig,
    normal_from_angles,
)
from nlos_calibration.arrays import Float64
from nlos_calibration.board_wall import (
    EXACT,
    BoardView,
    UncertainPlane,
    combine,
    plane_in_lidar,
    wall_with_board,
)
from nlos_calibration.errors import BoardRefusedError, WallRefusedError
from nlos_calibration.wall import WallFit, WallMeasures, fit_wall, measures_of
from synthetic_scenes import at_near_edge, clean_infrared, corners_px, infrared_frames

from nlos_cam.calibrate import View, depth_statistics

RIG = load_rig("bare-wall")
PINHOLE = RIG.pinhole
A4 = BOARDS["a4"]
SLOPES = np.array([1.2, -0.4, 3.5])
POSE = np.eye(4)
POSE[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.3, 0.05]))[0]
POSE[:3, 3] = [0.02, -0.014, 0.007]
NO_PRINT = PrintErrors(0.0, 1e-9, 1e-9)


def moved(slopes: Float64) -> Float64:
    return plane_in_lidar(slopes, np.zeros((3, 3)), POSE, EXACT)[0]


def test_plane_in_lidar_moves_plane_and_covariance_or_is_refused_between_camera_and_lidar() -> None:
    rays = np.column_stack([np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2)), np.ones(20)])
    points = rays / (rays @ SLOPES)[:, np.newaxis]
    there = points @ POSE[:3, :3].T + POSE[:3, 3]
    np.testing.assert_allclose(there @ moved(SLOPES), 1.0, rtol=1e-12)
    steps = 1e-6 * np.eye(3)
    by_slopes = np.stack(
        [(moved(SLOPES + step) - moved(SLOPES - step)) / 2e-6 for step in steps], axis=1
    )
    root = np.random.default_rng(1).standard_normal((3, 3)) * 1e-3
    covariance = plane_in_lidar(SLOPES, root @ root.T, POSE, EXACT)[1]
    np.testing.assert_allclose(
        covariance, by_slopes @ root @ root.T @ by_slopes.T, rtol=1e-5, atol=1e-12
    )
    behind = POSE.copy()
    behind[:3, 3] = POSE[:3, :3] @ (-2.0 * SLOPES / (SLOPES @ SLOPES))
    with pytest.raises(BoardRefusedError, match="between"):
        plane_in_lidar(SLOPES, np.zeros((3, 3)), behind, EXACT)


def test_fit_in_lidar_of_exact_corners_needs_lens_and_pose() -> None:
    bench = bench_at(0.25, 40.0, 5.0)
    straight = corners_px(A4, ColorCamera().view(bench.seen), bench.placed)
    inside = np.flatnonzero(((straight > 0.0) & (straight < [1280.0, 720.0])).all(axis=1))
    corners = Corners(inside, through_lens(straight[inside]))

    def found(**change: Any) -> WallMeasures:
        fit = board_wall.fit_in_lidar(corners, A4, replace(CALIBRATION, **change), NO_PRINT)
        return measures_of(fit.slopes, fit.covariance)

    exact = found(errors=EXACT)
    assert (exact.distance_m, exact.yaw_deg, exact.pitch_deg) == pytest.approx(
        (0.25, 40.0, 5.0), abs=1e-4
    )
    for wrong in (found(distortion=np.zeros(5)), found(lidar_from_camera=np.eye(4))):
        assert abs(wrong.distance_m - 0.25) > 3.0 * wrong.distance_std_m


@cache
def infrared(scale: float = 1.0) -> BoardView:
    """The mean of 20 frames of a board of that scale on the wall of the rig."""
    seen = View(RIG.wall_from_lidar, PINHOLE)
    placed = replace(at_near_edge(A4, seen), scale=scale)
    frames = infrared_frames(clean_infrared(A4, seen, placed), np.random.default_rng(0), 20)
    return BoardView(frames.mean(axis=0), PINHOLE)


@pytest.fixture(scope="module")
def depth() -> WallFit:
    depth_m = View(RIG.wall_from_lidar, PINHOLE).depth_m
    mean = depth_statistics(depth_m, np.random.default_rng(0), frames=20, noise=1.0)
    return fit_wall(mean.mean_m(), PINHOLE, np.random.default_rng(0), mean.noise())


def test_wall_with_board_combines_planes_that_agree_and_keeps_a_doubt_of_the_depth(
    depth: WallFit,
) -> None:
    fit, record = wall_with_board(depth, infrared(), A4, measured=False)
    assert isinstance(fit, WallFit)
    assert (fit.verdict, record.used, record.causes, record.depth_refused) == (
        "good",
        "both",
        (),
        "",
    )
    assert (fit.distance_m, fit.facing_deg) == pytest.approx((0.2, 45.0), abs=0.02)
    assert fit.distance_std_m <= depth.distance_std_m
    assert record.disagreement_m == pytest.approx(record.distance_m - depth.distance_m)
    assert record.disagreement_sigmas < 4.0
    np.testing.assert_allclose(fit.wall_from_lidar[2, 3], fit.distance_m)
    doubted = replace(depth, verdict="doubtful", advice="half of the view differs")
    fit, _ = wall_with_board(doubted, infrared(), A4, measured=False)
    assert (fit.verdict, fit.advice) == ("doubtful", "half of the view differs")


@pytest.mark.parametrize(("measured", "used"), [(False, "depth"), (True, "board")])
def test_wall_with_board_doubts_a_print_at_97_percent(
    depth: WallFit, measured: bool, used: str
) -> None:
    fit, record = wall_with_board(depth, infrared(0.97), A4, measured=measured)
    assert (fit.verdict, record.used) == ("doubtful", used)
    assert record.disagreement_m == pytest.approx(0.2 / 0.97 - 0.2, abs=5e-4)
    assert used in fit.advice
    assert ("scale" in fit.advice) is not measured
    assert fit.distance_m == pytest.approx(0.2 / 0.97 if measured else 0.2, abs=5e-4)


@pytest.mark.parametrize("light", ["infrared", "colour"])
def test_wall_with_board_in_colour_may_blame_the_colour_camera(
    depth: WallFit, light: Light
) -> None:
    fit, record = wall_with_board(depth, replace(infrared(0.97), light=light), A4, measured=False)
    assert record.seen_in == light
    for text in (fit.advice, record.causes[-1]):
        assert ("color camera" in text) is (light == "colour")
    _, agreed = wall_with_board(depth, replace(infrared(), light=light), A4, measured=False)
    assert (agreed.seen_in, agreed.causes) == (light, ())


def test_wall_with_board_doubts_board_alone_and_gives_advice() -> None:
    refusal = WallRefusedError("the wall is not flat: take another")
    fit, record = wall_with_board(refusal, infrared(), A4, measured=False)
    assert isinstance(fit, board_wall.WallByBoard)
    assert (fit.verdict, record.used, record.depth_refused) == ("doubtful", "board", str(refusal))
    assert str(refusal) in fit.advice
    assert record.disagreement_m is record.disagreement_deg is record.disagreement_sigmas is None
    assert fit.distance_m == pytest.approx(0.2, abs=3.0 * fit.distance_std_m)
    assert fit.distance_m == record.distance_m
    np.testing.assert_allclose(fit.wall_from_lidar, RIG.wall_from_lidar, atol=3e-3)
    far, _ = wall_with_board(refusal, infrared(), A4.measured(60.0), measured=True)
    assert far.distance_m == pytest.approx(0.4, abs=0.005)
    assert "10 cm" in far.advice


def test_wall_with_board_refusal_names_the_light(depth: WallFit) -> None:
    for view, light in (
        (BoardView(np.full((480, 640), 40.0), PINHOLE), "infrared"),
        (CALIBRATION, "colour"),
    ):
        with pytest.raises(BoardRefusedError, match=light):
            wall_with_board(depth, view, A4, measured=False)


def plane(
    distance_m: float, yaw_deg: float = 45.0, *, std_m: float = 1e-4, std_deg: float = 0.02
) -> UncertainPlane:
    normal = normal_from_angles(np.radians(yaw_deg), 0.1)
    along = np.outer(normal, normal)
    covariance = (std_m / distance_m**2) ** 2 * along
    return UncertainPlane(
        -normal / distance_m,
        covariance + (np.radians(std_deg) / distance_m) ** 2 * (np.eye(3) - along),
    )


def shaken(of: UncertainPlane, generator: np.random.Generator) -> UncertainPlane:
    return UncertainPlane(generator.multivariate_normal(of.slopes, of.covariance), of.covariance)


def test_combine_of_equal_planes_halves_the_covariance_and_keeps_an_exact_plane() -> None:
    both = combine(plane(0.2), plane(0.2), measured=False)
    assert (both.used, both.causes) == ("both", ())
    np.testing.assert_allclose(both.plane.slopes, plane(0.2).slopes)
    np.testing.assert_allclose(both.plane.covariance, 0.5 * plane(0.2).covariance)
    assert both.disagreement.sigmas == pytest.approx(0.0, abs=1e-9)
    exact = UncertainPlane(plane(0.2).slopes, np.zeros((3, 3)))
    both = combine(exact, plane(0.2001), measured=False)
    np.testing.assert_allclose(both.plane.slopes, exact.slopes)
    np.testing.assert_allclose(both.plane.covariance, 0.0, atol=1e-15)


def test_combine_takes_each_quantity_from_the_better_plane() -> None:
    depth = plane(0.2, 45.0, std_m=1e-5, std_deg=1.0)
    board = plane(0.2005, 45.5, std_m=1e-3, std_deg=0.01)
    both = combine(depth, board, measured=False)
    assert both.plane.distance_m == pytest.approx(0.2, abs=2e-5)
    assert both.plane.normal @ board.normal == pytest.approx(1.0, abs=1e-7)
    for one in (depth, board):
        assert (np.linalg.eigvalsh(one.covariance - both.plane.covariance) > -1e-9).all()


def test_disagreement_has_distance_angle_and_sigmas() -> None:
    apart = board_wall.disagreement(plane(0.2, 45.0), plane(0.2003, 45.0))
    assert apart.distance_m == pytest.approx(0.0003)
    assert apart.angle_deg == pytest.approx(0.0, abs=1e-6)
    assert apart.distance_sigmas == pytest.approx(0.3 / np.hypot(0.1, 0.1), rel=0.01)
    assert apart.angle_sigmas < 1e-6
    turned = board_wall.disagreement(plane(0.2, 45.0), plane(0.2, 45.1))
    expected_deg = 0.1 * np.cos(0.1)
    assert turned.angle_deg == pytest.approx(expected_deg, rel=1e-3)
    assert turned.angle_sigmas == pytest.approx(expected_deg / np.hypot(0.02, 0.02), rel=0.01)
    assert turned.distance_sigmas < 0.1


def test_combine_rarely_disagrees_by_chance_and_holds_the_truth_as_often_as_stated() -> None:
    generator = np.random.default_rng(0)
    depth = plane(0.2)
    board = plane(0.2, std_m=5e-4, std_deg=0.05)
    sigmas = list[float]()
    inside = list[bool]()
    for _ in range(1000):
        both = combine(shaken(depth, generator), shaken(board, generator), measured=False)
        sigmas.append(both.disagreement.sigmas)
        off = both.plane.slopes - depth.slopes
        inside.append(
            off @ np.linalg.solve(both.plane.covariance, off) < 7.815
        )  # 95 % of a chi-square of three
    assert np.mean(np.square(sigmas)) == pytest.approx(3.0, rel=0.1)
    assert np.mean(np.array(sigmas) > board_wall.AGREE_SIGMAS) < 0.004
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_combine_names_causes_that_explain_it_and_no_others() -> None:
    """Squares taken for 30 mm that are 29.1 mm put the wall 3 % too far away."""
    causes = combine(plane(0.2), plane(0.2 / 0.97, std_m=5e-4), measured=False).causes
    assert any("97.0 %" in cause for cause in causes)
    # along the axis the same wall is farther than along its normal
    offset_mm = 1e3 * 0.2 * (1 / 0.97 - 1) / (np.cos(np.radians(45.0)) * np.cos(0.1))
    assert any(f"{offset_mm:+.1f} mm" in cause for cause in causes)
    assert not any("angle" in cause for cause in causes)
    (cause,) = combine(plane(0.2, 45.0), plane(0.2, 46.005), measured=False).causes
    assert "1.00 degrees" in cause
    causes = combine(plane(0.2), plane(0.204), measured=True).causes
    assert [cause for cause in causes if "offset" in cause]
    assert not [cause for cause in causes if "scale" in cause]
    causes = combine(plane(0.2), plane(0.4), measured=False).causes
    assert causes
    assert not [cause for cause in causes if "scale" in cause or "offset" in cause]
