"""A board gives the wall's pose within its stated uncertainty wherever it hangs, or is refused."""

from dataclasses import replace

import numpy as np
import pytest
from board_trials import FLAT, BoardBench, bench_at, coverage, random_bench
from nlos_calibration import PrintErrors, find_corners, fit_board


def assert_measured(
    bench: BoardBench, frames: int = 10, within_mm: float = 1.0, within_deg: float = 0.2
) -> None:
    (distance_mm, yaw_off_deg, pitch_off_deg), _ = bench.compare(
        bench.fit_image(frames, np.random.default_rng(0))
    )
    assert abs(distance_mm) < within_mm
    assert np.hypot(yaw_off_deg, pitch_off_deg) < within_deg


RANGES = [
    (distance_m, yaw_deg)
    for distance_m in (0.15, 0.20, 0.30)
    for yaw_deg in (15.0, 30.0, 45.0, 60.0, 75.0)
]
TILTED = [(0.25, 40.0, 12.0), (0.25, 40.0, -12.0), (0.25, 0.0, 20.0), (0.25, 0.0, 0.0)]


@pytest.mark.parametrize("wall", [*RANGES, *TILTED])
def test_board_measures_walls_of_the_papers_ranges_and_tilted(
    wall: tuple[float, ...],
) -> None:
    assert_measured(bench_at(*wall))


@pytest.mark.parametrize("turn_deg", [90.0, 180.0, 37.0])
def test_board_may_hang_in_any_direction(turn_deg: float) -> None:
    bench = bench_at(0.25, 40.0)
    assert_measured(replace(bench, placed=replace(bench.placed, turn_rad=np.radians(turn_deg))))


@pytest.mark.parametrize("counts", [6.0, 150.0])
@pytest.mark.parametrize("spot_mm", [0.0, 2.0])
def test_board_pose_does_not_depend_on_gain_or_blur(counts: float, spot_mm: float) -> None:
    assert_measured(bench_at(0.2, 45.0, brightest_counts=counts, spot_mm=spot_mm), 20, 1.5, 0.3)


@pytest.mark.slow
def test_board_interval_holds_the_truth_as_often_as_stated() -> None:
    """Of 120 rendered benches, three quantities each: a share of 95 % is found between 91 and 99 %
    but once in 500.
    """
    generator = np.random.default_rng(5)
    found = coverage(
        120, lambda: random_bench(generator, FLAT), lambda bench: bench.fit_image(4, generator)
    )

    assert found.refused <= 2
    assert 0.91 < found.inside.mean() < 0.99


@pytest.mark.slow
@pytest.mark.parametrize("sigma_px", [0.03, 0.1, 0.3])
def test_board_interval_allows_for_bow_and_stretch(sigma_px: float) -> None:
    generator = np.random.default_rng(6)
    printed = PrintErrors()
    found = coverage(
        400,
        lambda: random_bench(generator, printed),
        lambda bench: bench.fit_corners(sigma_px, generator, printed),
    )

    assert found.refused <= 4
    assert ((found.inside > 0.91) & (found.inside < 0.985)).all()


@pytest.mark.slow
def test_board_of_more_frames_does_not_claim_more_than_it_knows() -> None:
    """The mean of planes of single frames would: the pixels' effect on a corner is the same in
    every frame.
    """
    bench = bench_at(0.3, 75.0)
    exact = PrintErrors(0.0, 1e-6, 1e-6)
    for frames in (1, 100):
        images = [
            bench.frames(frames, np.random.default_rng(seed)).mean(axis=0) for seed in range(4)
        ]
        fits = [
            fit_board(find_corners(one, bench.board), bench.board, bench.seen.pinhole, exact)
            for one in images
        ]
        assert np.mean([np.sqrt(np.mean(bench.compare(fit)[1] ** 2)) for fit in fits]) < 2.5
