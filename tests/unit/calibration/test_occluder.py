from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from nlos_calibration import MeanNoise, depth_noise_m, load_rig
from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import OccluderRefusedError
from nlos_calibration.occluder import MAX_BEHIND, OccluderFit, SheetFit, find_edge, find_occluder
from numpy.typing import NDArray
from synthetic_scenes import Sheet, ball, bench_depth
from synthetic_walls import View, view

PAPER = load_rig("paper-rig")
PINHOLE = PAPER.pinhole.scaled(160, 120)
NOISE = MeanNoise(np.full(1, 30.0))
PIXEL_M = 0.25 * 0.9 / PINHOLE.fx
"""Height on the paper's sheet, at its edge, that one pixel covers: 0.2 m / sin^2 for each
radian.
"""
ROWS = 40
COLUMNS = 100
PITCH_M = 0.002
Y_M = np.linspace(-0.1, 0.1, ROWS)
EDGE_M = 0.0601


@pytest.fixture(scope="module")
def seen() -> View:
    return view(0.2, 45.0, 0.0, PINHOLE)


def noisy(depth_m: Float64, seed: int = 0) -> Float64:
    """Return a mean of 30 frames of a depth map."""
    seen_m = np.where(depth_m < 9.0, depth_m, np.nan)
    errors = np.random.default_rng(seed).normal(0.0, 30**-0.5, depth_m.shape)
    return seen_m + errors * depth_noise_m(seen_m)


def fitted(seen: View, depth_m: Float64, **stds: float) -> OccluderFit:
    return find_occluder(depth_m, NOISE, PINHOLE, seen.pose, np.random.default_rng(1), **stds)


def found(sheet: Sheet | None, yaw_deg: float = 45.0, **stds: float) -> OccluderFit:
    seen = view(0.2, yaw_deg, 0.0, PINHOLE)
    return fitted(seen, noisy(bench_depth(seen, sheet)), **stds)


def sheet_with(normal: Float64) -> SheetFit:
    plane: Any = None
    return SheetFit(plane, normal, np.eye(3), np.array([0.1, 0.2, 0.9]))


@pytest.mark.parametrize(
    ("quantity", "std"),
    [
        (lambda sheet: sheet.x_m(0.3), lambda sheet: sheet.x_std_m(0.3)),
        (lambda sheet: sheet.lean, lambda sheet: sheet.lean_std),
    ],
    ids=["place", "lean"],
)
def test_sheet_propagates_uncertainty_by_its_derivatives(
    quantity: Callable[[SheetFit], float], std: Callable[[SheetFit], float]
) -> None:
    normal = np.array([2.0, 0.3, -0.4])
    sheet = sheet_with(normal)
    step = 1e-6
    moved = [quantity(sheet_with(normal + shift)) for shift in step * np.eye(3)]
    gradient = (np.array(moved) - quantity(sheet)) / step

    assert std(sheet) == pytest.approx(np.linalg.norm(gradient), rel=1e-4)


def test_find_occluder_finds_the_papers_to_half_a_pixel() -> None:
    fit = found(Sheet())

    assert abs(fit.x_m - 0.2) < 1e-4
    assert abs(fit.gap_m - 0.1) <= 0.6 * PIXEL_M
    assert abs(fit.tilt_deg) < 0.1
    assert 0.0 < fit.x_std_m < 1e-4
    assert fit.gap_std_m == pytest.approx(PIXEL_M / 12**0.5, rel=0.2)
    assert fit.pixels.mean() == pytest.approx(0.26, abs=0.02)
    assert fit.warnings == ()


def test_find_occluder_measures_lean_twist_and_edge() -> None:
    fit = found(Sheet(lean_deg=3.0, twist_deg=-2.0, edge_deg=2.0))

    assert fit.tilt_deg == pytest.approx(3.0, abs=0.1)
    assert fit.twist_deg == pytest.approx(-2.0, abs=0.1)
    assert fit.edge_deg == pytest.approx(2.0, abs=0.3)
    assert abs(fit.x_m - 0.2) < 1e-3


def test_find_occluder_uncertainty_holds_that_of_the_wall() -> None:
    plain = found(Sheet())
    less_sure = found(Sheet(), distance_std_m=0.003, yaw_std_deg=0.5)
    turn = np.radians(0.5)
    x_std_m = np.hypot(plain.x_std_m, 0.1 * turn)
    gap_std_m = np.sqrt(plain.gap_std_m**2 + 0.003**2 + (0.2 * turn) ** 2)

    assert less_sure.x_std_m == pytest.approx(x_std_m, rel=0.02)
    assert less_sure.gap_std_m == pytest.approx(gap_std_m, rel=0.02)


def test_find_occluder_gap_is_not_biased_by_flying_pixels(seen: View) -> None:
    errors_m: list[float] = []
    for step in np.linspace(0.0, 2.0, 9):
        gap_m = 0.1 + step * PIXEL_M
        mixed = bench_depth(seen, Sheet(gap_m=gap_m), beams=5)
        fit = fitted(seen, noisy(mixed))
        errors_m.append(fit.gap_m - gap_m)
        assert abs(errors_m[-1]) <= 1.96 * fit.gap_std_m

    assert abs(np.mean(errors_m)) < 0.35 * PIXEL_M


def wall_pixels(seen: View) -> NDArray[np.intp]:
    """Return flat indices of the pixels that see the wall beside the paper's sheet."""
    return np.flatnonzero(bench_depth(seen, Sheet()) == bench_depth(seen, None))


def test_find_occluder_suspects_an_object_in_some_beams(seen: View) -> None:
    depth_m = bench_depth(seen, Sheet())
    generator = np.random.default_rng(0)
    some = generator.choice(wall_pixels(seen), depth_m.size // 5, replace=False)
    depth_m.flat[some] += 0.15
    fit = fitted(seen, noisy(depth_m))

    assert abs(fit.gap_m - 0.1) < 2 * PIXEL_M
    assert "20%" in fit.why_unusable


def test_find_occluder_refuses_an_object_in_all_beams(seen: View) -> None:
    depth_m = bench_depth(seen, Sheet())
    depth_m.flat[wall_pixels(seen)] += 0.15
    with pytest.raises(OccluderRefusedError, match=f"{MAX_BEHIND:.0%}"):
        fitted(seen, noisy(depth_m))


def test_find_occluder_warns_of_a_finger_beside_the_sheet(seen: View) -> None:
    finger = ball(seen, (0.12, 0.02, 0.06), 0.015)
    fit = fitted(seen, noisy(np.minimum(bench_depth(seen, Sheet()), finger)))

    assert abs(fit.x_m - 0.2) < 1e-3
    assert len(fit.warnings) == 1


@pytest.mark.parametrize(
    ("yaw_deg", "sheet", "why"),
    [
        (45.0, None, r"0\.5\d m"),
        (15.0, Sheet(), r"0\.12 m"),
        (60.0, None, "occluder"),
        (29.0, Sheet(), r"\d columns"),
        (45.0, Sheet(lean_deg=8.0), r"8\.\d degrees .*\+8\.0"),
        (45.0, Sheet(twist_deg=-7.0), r"-7\.0"),
        (45.0, Sheet(edge_deg=7.0), r"[67]\.\d degrees"),
        (45.0, Sheet(gap_m=0.0), "gap"),
        (45.0, Sheet(gap_m=-0.05), "gap"),
        (-45.0, Sheet(x_m=-0.2), r"x = -0\.200 m"),
        (45.0, Sheet(bottom_m=-0.02, top_m=0.03), r"\d+% of the rows"),
        (75.0, Sheet(x_m=0.1, gap_m=0.05), "edge"),
        (70.0, Sheet(x_m=0.12, gap_m=0.22), r"\d+ mm"),
    ],
)
def test_find_occluder_refuses_a_sheet_it_cannot_trust(
    yaw_deg: float, sheet: Sheet | None, why: str
) -> None:
    with pytest.raises(OccluderRefusedError, match=why):
        found(sheet, yaw_deg)


@pytest.mark.parametrize("from_column", [80, 130])
def test_find_occluder_refuses_a_sheet_along_the_wall(seen: View, from_column: int) -> None:
    depth_m = seen.depth_m.copy()
    depth_m[:, from_column:] *= 0.7

    with pytest.raises(OccluderRefusedError, match=r"(89|90)\.\d degrees off"):
        fitted(seen, noisy(depth_m))


def test_find_occluder_refuses_a_box_beside_the_sheet(seen: View) -> None:
    box = bench_depth(seen, Sheet(0.08, 0.05, height_m=0.06))
    with pytest.raises(OccluderRefusedError, match=r"\d+%"):
        fitted(seen, noisy(np.minimum(bench_depth(seen, Sheet()), box)))


@pytest.mark.parametrize("centre_m", [(0.2, 0.02, 0.13), (0.1, 0.0, 0.1)])
def test_find_occluder_refuses_a_fist(seen: View, centre_m: tuple[float, float, float]) -> None:
    fist = ball(seen, centre_m, 0.045)
    with pytest.raises(OccluderRefusedError):
        fitted(seen, noisy(np.minimum(bench_depth(seen, None), fist)))


def points_on_sheet() -> Float64:
    """Return points (rows, columns, 3) of a sheet, each 2 mm higher than the one before."""
    height_m, y_m = np.meshgrid(PITCH_M * np.arange(COLUMNS), Y_M)
    return np.stack([np.full_like(y_m, 0.2), y_m, height_m], axis=-1)


POINTS_M = points_on_sheet()


def on_sheet(edge_m: Float64 | float = EDGE_M) -> Mask:
    """Return the pixels above the edge, which may have a height for each row."""
    return POINTS_M[..., 2] >= np.broadcast_to(edge_m, ROWS)[:, np.newaxis]


def test_find_edge_ignores_beams_over_the_sheets_upper_end() -> None:
    sheet = on_sheet()
    over = POINTS_M[..., 2] > 0.1
    edge = find_edge(POINTS_M, sheet & ~over, ~sheet | over)

    assert edge
    assert abs(edge.gap_m - EDGE_M) <= PITCH_M / 2


def test_find_edge_allows_for_stray_pixels() -> None:
    sheet = on_sheet()
    stray = np.random.default_rng(3).random(sheet.shape) < 0.1
    edge = find_edge(POINTS_M, sheet ^ stray, ~sheet ^ stray)

    assert edge
    assert abs(edge.gap_m - EDGE_M) < PITCH_M
    assert edge.gap_std_m < 2 * PITCH_M


def test_find_edge_of_a_ragged_sheet_is_as_uncertain_as_its_rows() -> None:
    sheet = on_sheet(0.06 + np.random.default_rng(0).normal(0.0, 0.004, ROWS))
    edge = find_edge(POINTS_M, sheet, ~sheet)

    assert edge
    assert edge.gap_std_m == pytest.approx(0.004, rel=0.3)


def test_find_edge_is_uniform_over_pixels_that_mix() -> None:
    """One pixel on either side of the edge is undecided, so that it lies between three."""
    sheet = on_sheet()
    surely_sheet = np.roll(sheet, 1, axis=1) & sheet
    surely_passed = np.roll(~sheet, -1, axis=1) & ~sheet
    edge = find_edge(POINTS_M, surely_sheet, surely_passed)

    assert edge
    assert edge.gap_std_m == pytest.approx(3 * PITCH_M / np.sqrt(12))


def test_find_edge_needs_beams_that_passed() -> None:
    sheet = on_sheet()
    assert find_edge(POINTS_M, sheet, np.zeros_like(sheet)) is None
