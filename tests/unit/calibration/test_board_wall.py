import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from nlos_calibration import BOARDS, BoardRecord, board_wall, load_rig, normal_from_angles
from nlos_calibration.arrays import Float64
from nlos_calibration.board_wall import (
    Combined,
    UncertainPlane,
    combine,
    wall_with_board,
    with_range_offset,
)
from nlos_calibration.errors import BoardRefusedError, WallRefusedError
from nlos_calibration.range_offset import CorrectedWall
from nlos_calibration.wall import WallFit, fit_wall
from synthetic_scenes import at_near_edge, clean_infrared, infrared_frames
from synthetic_walls import View, depth_statistics

RIG = load_rig("bare-wall")
PINHOLE = RIG.pinhole
A4 = BOARDS["a4"]
TRUE_M = 0.2
PRINTED_AT_97_PERCENT_M = TRUE_M / 0.97
"""Distance that squares taken for 30 mm give if they are 29.1 mm."""
CHI2_95_OF_3 = 7.815
"""95 % of a chi-square of three degrees of freedom lie below."""
REFUSAL = WallRefusedError("the wall is not flat: take another")


@cache
def infrared(scale: float = 1.0) -> Float64:
    """Mean of 20 frames of a board, printed at that scale, on the wall of the rig."""
    seen = View(RIG.wall_from_lidar, PINHOLE)
    placed = replace(at_near_edge(A4, seen), scale=scale)
    clean = clean_infrared(A4, seen, placed)
    return infrared_frames(clean, np.random.default_rng(0), 20).mean(axis=0)


@pytest.fixture(scope="module")
def depth() -> WallFit:
    depth_m = View(RIG.wall_from_lidar, PINHOLE).depth_m
    mean = depth_statistics(depth_m, np.random.default_rng(0), frames=20)
    return fit_wall(mean.mean_m(), PINHOLE, np.random.default_rng(0), mean.noise())


@pytest.fixture(scope="module")
def agreed(depth: WallFit) -> tuple[WallFit, BoardRecord]:
    """Wall of depth and a board printed to scale."""
    fit, record = wall_with_board(depth, infrared(), PINHOLE, A4, measured=False)
    assert isinstance(fit, WallFit)
    return fit, record


def test_depth_and_board_that_agree_are_combined(agreed: tuple[WallFit, BoardRecord]) -> None:
    fit, record = agreed

    assert fit.verdict == "good"
    assert record.used == "both"
    assert record.causes == ()
    assert record.depth_refused == ""


def test_combined_wall_is_true_and_at_least_as_certain(
    agreed: tuple[WallFit, BoardRecord], depth: WallFit
) -> None:
    fit, _ = agreed

    assert fit.distance_m == pytest.approx(TRUE_M, abs=0.02)
    assert fit.facing_deg == pytest.approx(45.0, abs=0.02)
    assert fit.distance_std_m <= depth.distance_std_m
    assert fit.wall_from_lidar[2, 3] == pytest.approx(fit.distance_m)


def test_record_holds_the_boards_distance_less_the_depths(
    agreed: tuple[WallFit, BoardRecord], depth: WallFit
) -> None:
    _, record = agreed

    assert record.disagreement_m == pytest.approx(record.distance_m - depth.distance_m)
    assert record.disagreement_sigmas < board_wall.AGREE_SIGMAS


def test_agreeing_board_keeps_a_doubtful_verdict_of_the_depth(depth: WallFit) -> None:
    doubtful = replace(depth, verdict="doubtful", advice="half of the view differs")
    fit, _ = wall_with_board(doubtful, infrared(), PINHOLE, A4, measured=False)

    assert fit.verdict == "doubtful"
    assert fit.advice == "half of the view differs"


def test_agreeing_board_judges_the_combined_wall_anew(depth: WallFit) -> None:
    """The depth alone was just out of range, the plane of both is inside."""
    beyond = replace(depth, verdict="out of range", advice="move the lidar 1 cm closer")
    fit, _ = wall_with_board(beyond, infrared(), PINHOLE, A4, measured=False)

    assert fit.verdict == "good"
    assert fit.advice.endswith("inside the paper's ranges; depth and board agree")


@pytest.mark.parametrize(
    ("measured", "used", "distance_m"),
    [(False, "depth", TRUE_M), (True, "board", PRINTED_AT_97_PERCENT_M)],
)
def test_board_printed_at_97_percent_makes_the_wall_doubtful(
    depth: WallFit, measured: bool, used: str, distance_m: float
) -> None:
    fit, record = wall_with_board(depth, infrared(0.97), PINHOLE, A4, measured=measured)

    assert fit.verdict == "doubtful"
    assert fit.distance_m == pytest.approx(distance_m, abs=5e-4)
    assert record.used == used
    assert record.disagreement_m == pytest.approx(PRINTED_AT_97_PERCENT_M - TRUE_M, abs=5e-4)
    assert used in fit.advice
    assert ("scale" in fit.advice) is not measured


def test_board_alone_gives_a_doubtful_wall_near_the_truth() -> None:
    fit, record = wall_with_board(REFUSAL, infrared(), PINHOLE, A4, measured=False)

    assert isinstance(fit, board_wall.WallByBoard)
    assert fit.verdict == "doubtful"
    assert fit.distance_m == pytest.approx(TRUE_M, abs=3.0 * fit.distance_std_m)
    assert fit.distance_m == record.distance_m
    np.testing.assert_allclose(fit.wall_from_lidar, RIG.wall_from_lidar, atol=3e-3)


def test_board_alone_names_why_the_depth_was_refused() -> None:
    fit, record = wall_with_board(REFUSAL, infrared(), PINHOLE, A4, measured=False)

    assert str(REFUSAL) in fit.advice
    assert record.used == "board"
    assert record.depth_refused == str(REFUSAL)
    assert record.disagreement_m is None
    assert record.disagreement_deg is None
    assert record.disagreement_sigmas is None


def test_board_alone_advises_to_move_a_lidar_too_far_away() -> None:
    twice = A4.measured(2.0 * A4.square_mm)
    fit, _ = wall_with_board(REFUSAL, infrared(), PINHOLE, twice, measured=True)

    assert fit.distance_m == pytest.approx(2.0 * TRUE_M, abs=0.005)
    assert "10 cm" in fit.advice


@pytest.mark.parametrize("refused", [True, False])
def test_range_offset_that_the_bend_shows_ends_the_doubt(depth: WallFit, *, refused: bool) -> None:
    bent = REFUSAL if refused else replace(depth, verdict="doubtful")
    by_board, _ = wall_with_board(bent, infrared(), PINHOLE, A4, measured=True)
    fit = with_range_offset(by_board, bent, CorrectedWall(depth, 0.0045, 5e-4, "depth"))

    assert fit.verdict == "good"
    assert "+4.5 mm" in fit.advice
    assert (fit.distance_m, fit.yaw_deg) == (by_board.distance_m, by_board.yaw_deg)
    np.testing.assert_array_equal(fit.wall_from_lidar, by_board.wall_from_lidar)
    assert fit.residual_m == depth.residual_m


def test_range_offset_that_no_bend_shows_leaves_the_doubt(depth: WallFit) -> None:
    by_board, _ = wall_with_board(depth, infrared(0.97), PINHOLE, A4, measured=True)
    fit = with_range_offset(by_board, depth, CorrectedWall(depth, 0.0045, 5e-4, "depth"))

    assert fit.verdict == "doubtful"
    assert by_board.advice in fit.advice
    assert "+4.5 mm" in fit.advice


def test_range_offset_that_leaves_the_wall_turned_is_none(depth: WallFit) -> None:
    by_board, _ = wall_with_board(REFUSAL, infrared(), PINHOLE, A4, measured=True)
    turned = replace(depth, yaw_deg=depth.yaw_deg + 1.0)

    assert with_range_offset(by_board, REFUSAL, CorrectedWall(turned, 0.01, 5e-4, "depth")) is None


def test_image_without_a_board_is_refused(depth: WallFit) -> None:
    blank = np.full((480, 640), 40.0)
    with pytest.raises(BoardRefusedError, match="infrared"):
        wall_with_board(depth, blank, PINHOLE, A4, measured=False)


def plane(
    distance_m: float, yaw_deg: float = 45.0, *, std_m: float = 1e-4, std_deg: float = 0.02
) -> UncertainPlane:
    """Return a plane whose distance and angles are known independently."""
    normal = normal_from_angles(np.radians(yaw_deg), 0.1)
    along = np.outer(normal, normal)
    across = np.eye(3) - along
    by_distance = (std_m / distance_m**2) ** 2 * along
    by_angle = (np.radians(std_deg) / distance_m) ** 2 * across
    return UncertainPlane(-normal / distance_m, by_distance + by_angle)


def drawn(true: UncertainPlane, generator: np.random.Generator) -> UncertainPlane:
    """Return a measurement of the plane with its errors."""
    slopes = generator.multivariate_normal(true.slopes, true.covariance)
    return UncertainPlane(slopes, true.covariance)


def test_combine_of_equal_planes_halves_the_covariance() -> None:
    both = combine(plane(0.2), plane(0.2), measured=False)

    assert both.used == "both"
    assert both.causes == ()
    np.testing.assert_allclose(both.plane.slopes, plane(0.2).slopes)
    np.testing.assert_allclose(both.plane.covariance, 0.5 * plane(0.2).covariance)
    assert both.disagreement.sigmas == pytest.approx(0.0, abs=1e-9)


def test_combine_keeps_an_exact_plane() -> None:
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
        gain = one.covariance - both.plane.covariance
        assert (np.linalg.eigvalsh(gain) > -1e-9).all()


def test_disagreement_in_distance_is_in_joint_uncertainties() -> None:
    apart = board_wall.disagreement(plane(0.2), plane(0.2003))

    assert apart.distance_m == pytest.approx(0.0003)
    assert apart.angle_deg == pytest.approx(0.0, abs=1e-6)
    assert apart.distance_sigmas == pytest.approx(0.3 / np.hypot(0.1, 0.1), rel=0.01)
    assert apart.angle_sigmas < 1e-6


def test_disagreement_in_angle_is_in_joint_uncertainties() -> None:
    turned = board_wall.disagreement(plane(0.2, 45.0), plane(0.2, 45.1))
    # on a wall pitched by 0.1, a turn in yaw moves the normal by its cosine
    expected_deg = 0.1 * np.cos(0.1)

    assert turned.angle_deg == pytest.approx(expected_deg, rel=1e-3)
    assert turned.angle_sigmas == pytest.approx(expected_deg / np.hypot(0.02, 0.02), rel=0.01)
    assert turned.distance_sigmas < 0.1


@pytest.fixture(scope="module")
def drawings() -> list[Combined]:
    """Combinations of a thousand measurements of one wall by depth and board."""
    generator = np.random.default_rng(0)
    depth = plane(0.2)
    board = plane(0.2, std_m=5e-4, std_deg=0.05)
    return [
        combine(drawn(depth, generator), drawn(board, generator), measured=False)
        for _ in range(1000)
    ]


def test_planes_disagree_by_chance_as_rarely_as_stated(drawings: list[Combined]) -> None:
    sigmas = np.array([both.disagreement.sigmas for both in drawings])

    assert np.mean(sigmas**2) == pytest.approx(3.0, rel=0.1)
    assert np.mean(sigmas > board_wall.AGREE_SIGMAS) < 0.004


def test_combined_plane_holds_the_truth_as_often_as_stated(drawings: list[Combined]) -> None:
    inside: list[bool] = []
    for both in drawings:
        off = both.plane.slopes - plane(0.2).slopes
        chi2 = off @ np.linalg.solve(both.plane.covariance, off)
        inside.append(chi2 < CHI2_95_OF_3)

    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def causes_of(board: UncertainPlane, *, measured: bool = False, per_offset: float = 1.0) -> str:
    both = combine(plane(0.2), board, measured=measured, per_offset=per_offset)
    return "\n".join(both.causes)


def test_cause_of_a_distance_is_scale_or_offset_with_amounts() -> None:
    causes = causes_of(plane(PRINTED_AT_97_PERCENT_M, std_m=5e-4), per_offset=0.8)
    offset_m = (PRINTED_AT_97_PERCENT_M - TRUE_M) / 0.8

    assert "97.0 %" in causes
    assert f"{1e3 * offset_m:+.1f} mm" in causes
    assert "angle" not in causes


def test_cause_of_short_depths_is_their_offset() -> None:
    depth_m = View(RIG.wall_from_lidar, PINHOLE).depth_m - 0.008
    mean = depth_statistics(depth_m, np.random.default_rng(0), frames=5)
    short = fit_wall(mean.mean_m(), PINHOLE, np.random.default_rng(0), mean.noise())
    _, record = wall_with_board(short, infrared(), PINHOLE, A4, measured=True)

    (amount_mm,) = re.findall(r"offset: ([+-]\d+\.\d) mm", " ".join(record.causes))
    assert float(amount_mm) == pytest.approx(8.0, abs=0.6)  # the print's scale


def test_cause_of_a_turn_is_the_angle_alone() -> None:
    (cause,) = combine(plane(0.2, 45.0), plane(0.2, 46.005), measured=False).causes
    assert "1.00 degrees" in cause


def test_measured_board_has_no_scale_error_among_the_causes() -> None:
    causes = causes_of(plane(0.204), measured=True)

    assert "offset" in causes
    assert "scale" not in causes


def test_implausible_amounts_are_no_causes() -> None:
    causes = causes_of(plane(0.4))

    assert causes
    assert "scale" not in causes
    assert "offset" not in causes
