from typing import Any

import numpy as np
import pytest
from nlos_calibration import MeanNoise, depth_noise_m, load_rig
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


@pytest.fixture(scope="module")
def seen() -> View:
    return view(0.2, 45.0, 0.0, PINHOLE)


def noisy(depth_m: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    seen_m = np.where(depth_m < 9.0, depth_m, np.nan)
    return seen_m + np.random.default_rng(seed).normal(
        0.0, 30**-0.5, depth_m.shape
    ) * depth_noise_m(seen_m)


def fitted(seen: View, depth_m: NDArray[np.float64], **stds: float) -> OccluderFit:
    return find_occluder(depth_m, NOISE, PINHOLE, seen.pose, np.random.default_rng(1), **stds)


def found(sheet: Sheet | None, yaw_deg: float = 45.0, **stds: float) -> OccluderFit:
    seen = view(0.2, yaw_deg, 0.0, PINHOLE)
    return fitted(seen, noisy(bench_depth(seen, sheet)), **stds)


def test_sheet_propagates_uncertainty_by_its_derivatives() -> None:
    normal = np.array([2.0, 0.3, -0.4])
    step = 1e-6
    none: Any = None
    sheets = [
        SheetFit(none, normal + shift, np.eye(3), np.array([0.1, 0.2, 0.9]))
        for shift in step * np.eye(4, 3, -1)
    ]
    for std, values in (
        (sheets[0].x_std_m(0.3), [sheet.x_m(0.3) for sheet in sheets]),
        (sheets[0].lean_std, [sheet.lean for sheet in sheets]),
    ):
        gradient = (np.array(values[1:]) - values[0]) / step
        assert std == pytest.approx(np.linalg.norm(gradient), rel=1e-4)


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
    assert (fit.tilt_deg, fit.twist_deg) == pytest.approx((3.0, -2.0), abs=0.1)
    assert fit.edge_deg == pytest.approx(2.0, abs=0.3)
    assert abs(fit.x_m - 0.2) < 1e-3


def test_find_occluder_uncertainty_holds_that_of_the_wall() -> None:
    plain = found(Sheet())
    less_sure = found(Sheet(), distance_std_m=0.003, yaw_std_deg=0.5)
    turn = np.radians(0.5)
    assert less_sure.x_std_m == pytest.approx(np.hypot(plain.x_std_m, 0.1 * turn), rel=0.02)
    expected = np.sqrt(plain.gap_std_m**2 + 0.003**2 + (0.2 * turn) ** 2)
    assert less_sure.gap_std_m == pytest.approx(expected, rel=0.02)


def test_find_occluder_gap_is_not_biased_by_flying_pixels(seen: View) -> None:
    errors_m = []
    for step in np.linspace(0.0, 2.0, 9):
        gap_m = 0.1 + step * PIXEL_M
        fit = fitted(seen, noisy(bench_depth(seen, Sheet(gap_m=gap_m), beams=5)))
        errors_m.append(fit.gap_m - gap_m)
        assert abs(errors_m[-1]) <= 1.96 * fit.gap_std_m
    assert abs(np.mean(errors_m)) < 0.35 * PIXEL_M


def test_find_occluder_tolerates_an_object_in_some_beams_only(seen: View) -> None:
    depth_m = bench_depth(seen, Sheet())
    on_wall = np.flatnonzero(depth_m == bench_depth(seen, None))
    some = depth_m.copy()
    some.flat[np.random.default_rng(0).choice(on_wall, depth_m.size // 5, replace=False)] += 0.15
    fit = fitted(seen, noisy(some))
    assert abs(fit.gap_m - 0.1) < 2 * PIXEL_M
    assert "20%" in fit.doubt
    depth_m.flat[on_wall] += 0.15
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


def test_find_occluder_refuses_a_fist_or_a_box_beside_the_sheet(seen: View) -> None:
    box = bench_depth(seen, Sheet(0.08, 0.05, height_m=0.06))
    with pytest.raises(OccluderRefusedError, match=r"\d+%"):
        fitted(seen, noisy(np.minimum(bench_depth(seen, Sheet()), box)))
    for centre_m in ((0.2, 0.02, 0.13), (0.1, 0.0, 0.1)):
        with pytest.raises(OccluderRefusedError):
            fitted(seen, noisy(np.minimum(bench_depth(seen, None), ball(seen, centre_m, 0.045))))


def met() -> NDArray[np.float64]:
    """Return the points of a sheet on which each pixel lies 2 mm higher than the one before."""
    height_m, y_m = np.meshgrid(PITCH_M * np.arange(COLUMNS), Y_M)
    return np.stack([np.full_like(y_m, 0.2), y_m, height_m], axis=-1)


def labels(edge_m: NDArray[np.float64] | float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which pixels see the sheet and which see past it, by an edge for each row."""
    sheet = met()[..., 2] >= np.broadcast_to(edge_m, ROWS)[:, np.newaxis]
    return sheet, ~sheet


def test_find_edge_allows_for_raggedness_strays_and_upper_end() -> None:
    sheet, passed = labels(0.0601)
    over = met()[..., 2] > 0.1
    assert abs(find_edge(met(), sheet & ~over, passed | over).gap_m - 0.0601) <= PITCH_M / 2
    stray = np.random.default_rng(3).random(sheet.shape) < 0.1
    strewn = find_edge(met(), sheet ^ stray, passed ^ stray)
    assert abs(strewn.gap_m - 0.0601) < PITCH_M
    assert strewn.gap_std_m < 2 * PITCH_M
    ragged = find_edge(met(), *labels(0.06 + np.random.default_rng(0).normal(0.0, 0.004, ROWS)))
    assert ragged.gap_std_m == pytest.approx(0.004, rel=0.3)
    mixed = find_edge(
        met(), np.roll(sheet, 1, axis=1) & sheet, np.roll(passed, -1, axis=1) & passed
    )
    assert mixed.gap_std_m == pytest.approx(3 * PITCH_M / np.sqrt(12))
    assert find_edge(met(), sheet, np.zeros_like(passed)) is None
