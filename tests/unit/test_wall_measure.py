import numpy as np
import pytest
from nlos_calibration.bare_wall import BareWallStatistics
from nlos_calibration.board import BOARDS
from nlos_calibration.errors import BoardRefusedError, CalibrationError, WallRefusedError
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import wall_depth

from nlos_cam.wall_look import Seen
from nlos_cam.wall_measure import by_board, by_depth

RIG = load_rig("bare-wall")
INTRINSICS = RIG.pinhole.scaled(160, 120)


@pytest.fixture
def seen() -> Seen:
    generator = np.random.default_rng(0)
    depth_m = wall_depth(RIG.wall_from_lidar, INTRINSICS)
    statistics, dark = BareWallStatistics(INTRINSICS), np.zeros(depth_m.shape, np.uint8)
    cells = np.full((64, 80), 0.2, np.float32)
    for _ in range(10):
        noise_m = generator.standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
        statistics.add((depth_m + noise_m).astype(np.float32), dark, cells, cells)
    return Seen("sim", statistics, INTRINSICS, "", "", {})


def test_depth_tells_the_wall(seen: Seen) -> None:
    fit, facts = by_depth(seen)
    assert facts == {}
    assert fit.distance_m == pytest.approx(0.2, abs=4 * fit.distance_std_m)


def test_a_tape_tells_the_offset_too(seen: Seen) -> None:
    fit, facts = by_depth(seen, 0.204)
    assert fit.distance_m == pytest.approx(0.204, abs=1e-5)
    assert facts["range_offset_m"] == pytest.approx(0.004 * np.sqrt(2.0), abs=2e-5)
    with pytest.raises(CalibrationError, match="the tape says"):
        by_depth(seen, 0.3)


def test_nothing_seen_is_refused() -> None:
    nothing = Seen("sim", BareWallStatistics(INTRINSICS), INTRINSICS, "", "", {})
    with pytest.raises(WallRefusedError):
        by_depth(nothing)


def test_a_board_that_is_not_there_is_refused(seen: Seen) -> None:
    with pytest.raises(BoardRefusedError):
        by_board(seen, BOARDS["a4"], None)
