"""Someone measures the bare wall by a printed board, then the occluder, with a lidar whose depths are
off.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from nlos_calibration import BOARDS, BareWallStatistics, MeasuredWall, load_rig
from nlos_calibration.errors import WallRefusedError
from synthetic_scenes import Sheet, at_near_edge, bench_depth, clean_infrared, infrared_frames
from synthetic_walls import LONGEST_DEPTH_M, View, view

from nlos_cam.calibrate import measure

A4 = BOARDS["a4"]
PINHOLE = load_rig("bare-wall").pinhole.scaled(320, 240)
WALL_M = 0.2
BARE = view(WALL_M, 45.0, 0.0, PINHOLE)
CELLS = np.full((64, 80), 0.2, np.float32)
FRAMES = 10
SHEET = Sheet(x_m=0.2, gap_m=0.1)


def capture(depth_m: np.ndarray, ir: np.ndarray, short_m: float) -> measure.CaptureStatistics:
    """Return the statistics of noisy frames of a lidar whose depths are all too short."""
    statistics = BareWallStatistics(PINHOLE)
    generator = np.random.default_rng(len(ir))
    seen_m = np.where(depth_m < LONGEST_DEPTH_M, depth_m, np.nan)
    for _ in range(FRAMES):
        noise_m = generator.standard_normal(seen_m.shape) * (0.0005 + 0.002 * seen_m)
        statistics.add((seen_m - short_m + noise_m).astype(np.float32), ir, CELLS, CELLS)
    return measure.CaptureStatistics("l515", statistics, PINHOLE, "", "", {})


@cache
def board_in_infrared(scale: float) -> np.ndarray:
    placed = replace(at_near_edge(A4, BARE), scale=scale)
    return infrared_frames(clean_infrared(A4, BARE, placed), np.random.default_rng(0), 1)[0]


@cache
def bare_wall(
    short_m: float, square_mm: float | None = A4.square_mm, scale: float = 1.0
) -> MeasuredWall:
    """Return the wall by `calibrate --wall --board`."""
    seen = capture(BARE.depth_m, board_in_infrared(scale), short_m)
    fit, fields = measure.measure_by_board(seen, A4, square_mm)
    return MeasuredWall(seen.record(fit, fields), seen.reference(fit.inliers))


def with_occluder(bare: MeasuredWall, short_m: float, seen: View = BARE) -> Any:
    """Return the record by `calibrate --occluder`."""
    dark = np.zeros((PINHOLE.height, PINHOLE.width), np.uint8)
    record, _ = measure.measure_occluder(capture(bench_depth(seen, SHEET), dark, short_m), bare)
    return record


@pytest.mark.parametrize("short_m", [-0.02, -0.0045, 0.0045, 0.02])
def test_board_gives_the_range_offset(short_m: float) -> None:
    record = bare_wall(short_m).record

    assert record.board.used == "board"
    assert record.range_offset_cause == "depth"
    assert record.range_offset_m == pytest.approx(short_m, abs=3 * record.range_offset_std_m)
    assert record.distance_m == pytest.approx(WALL_M, abs=3 * record.distance_std_m)
    assert record.verdict == "good"


@pytest.mark.parametrize("short_m", [-0.02, -0.0045, 0.0, 0.0045, 0.02])
def test_occluder_is_found_after_a_board(short_m: float) -> None:
    found = with_occluder(bare_wall(short_m), short_m).occluder

    assert found.x_m == pytest.approx(SHEET.x_m, abs=3 * found.x_std_m + 2e-4)
    assert found.gap_m == pytest.approx(SHEET.gap_m, abs=3 * found.gap_std_m)


@pytest.mark.parametrize("short_m", [-0.0045, 0.0, 0.0045])
@pytest.mark.parametrize("square_mm", [A4.square_mm, None])
@pytest.mark.parametrize(
    ("moved", "amount"),
    [
        (view(WALL_M + 0.003, 45.0, 0.0, PINHOLE), r"3\.0 mm farther"),
        (view(WALL_M, 45.5, 0.0, PINHOLE), r"\+0\.[45]"),
    ],
    ids=["back", "turned"],
)
def test_lidar_that_moved_after_a_board_is_named(
    short_m: float, square_mm: float | None, moved: View, amount: str
) -> None:
    with pytest.raises(WallRefusedError, match=f"moved.*{amount}"):
        with_occluder(bare_wall(short_m, square_mm), short_m, moved)


def test_lidar_whose_range_drifted_after_a_board_is_named() -> None:
    with pytest.raises(WallRefusedError, match="moved"):
        with_occluder(bare_wall(0.0045), 0.0085)


@pytest.mark.parametrize("short_m", [-0.0045, 0.0045])
def test_occluder_is_found_where_the_offset_is_unknown(short_m: float) -> None:
    """The print was not measured, so that it may be the board that is off."""
    bare = bare_wall(short_m, None)

    assert bare.record.range_offset_m == 0.0
    assert with_occluder(bare, short_m).verdict == "doubtful"


def test_board_of_another_size_than_stated_gives_no_offset() -> None:
    record = bare_wall(0.0, A4.square_mm, 0.96).record

    assert record.board.used == "board"
    assert record.range_offset_std_m is None
    assert record.verdict == "doubtful"


def test_occluder_is_found_beside_a_board_of_another_size() -> None:
    assert with_occluder(bare_wall(0.0, A4.square_mm, 0.98), 0.0).verdict == "doubtful"
