from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from nlos_calibration.board import BOARDS
from nlos_calibration.errors import BoardRefusedError, CalibrationError, OccluderRefusedError, WallRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWallStatistics
from nlos_calibration.rig import LidarPose, Occluder, Rig, load_rig
from nlos_calibration.wall import wall_depth
from nlos_calibration.wall_record import MeasuredWall, wall_record

from nlos_cam.calibrate.measure import Seen, by_board, by_depth, by_occluder
from nlos_cam.render.geometry import cast

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


BENCH = load_rig("paper-rig")


def bench_seen(rig: Rig, intrinsics: Intrinsics = INTRINSICS) -> Seen:
    """What the lidar of a rig sees with its occluder in place and nothing hidden, by its beams."""
    generator, beams = np.random.default_rng(1), cast(rig, intrinsics)
    depth_m = (beams.length_m * beams.cos_axis).reshape(intrinsics.height, intrinsics.width)
    statistics, dark = BareWallStatistics(intrinsics), np.zeros(depth_m.shape, np.uint8)
    cells = np.full((64, 80), 0.2, np.float32)
    for _ in range(20):
        noise_m = generator.standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
        statistics.add((depth_m + noise_m).astype(np.float32), dark, cells, cells)
    return Seen("sim", statistics, intrinsics, "", "", {})


@pytest.fixture
def bare(seen: Seen) -> MeasuredWall:
    fit, _ = by_depth(seen)
    return MeasuredWall(wall_record(fit, INTRINSICS, camera="sim", frames=10, created=date(2026, 1, 2)), None)


@pytest.mark.parametrize(("x_m", "gap_m"), [(0.2, 0.1), (0.22, 0.08), (0.19, 0.11)])
def test_an_occluder_is_found_beside_the_known_wall(bare: MeasuredWall, x_m: float, gap_m: float) -> None:
    seen = bench_seen(BENCH.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=gap_m)}))
    record, inliers = by_occluder(seen, bare)
    assert record.occluder is not None
    assert record.occluder.source == "detected"
    assert (record.occluder.x_m, record.occluder.gap_m) == pytest.approx((x_m, gap_m), abs=0.002)
    assert record.rig.occluder == Occluder(x_m=record.occluder.x_m, z_min_m=record.occluder.gap_m)
    assert record.verdict == "good"
    assert record.rig.lidar == bare.record.rig.lidar
    far = np.abs(wall_depth(RIG.wall_from_lidar, INTRINSICS) - seen.statistics.depth.mean_m()) > 0.02
    assert 0.1 < far.mean() < 0.5
    assert not (inliers & far).any()
    assert inliers[~far].mean() > 0.95


def test_a_gap_out_of_the_papers_range_is_advised_on(bare: MeasuredWall) -> None:
    record, _ = by_occluder(bench_seen(BENCH.model_copy(update={"occluder": Occluder(x_m=0.2, z_min_m=0.04)})), bare)
    assert record.verdict == "out of range"
    assert "0.05 to 0.20 needed: move it 1 cm away from the wall" in record.advice


def test_a_lidar_that_moved_meanwhile_is_noticed(bare: MeasuredWall) -> None:
    moved = BENCH.model_copy(update={"lidar": LidarPose(distance_m=0.203, yaw_deg=45.0)})
    with pytest.raises(WallRefusedError, match=r"the lidar has moved since .*: the wall is 3\.0 mm farther"):
        by_occluder(bench_seen(moved), bare)


def test_a_lidar_that_nodded_meanwhile_is_noticed(bare: MeasuredWall) -> None:
    """It faces a wall at 45 degrees as before, to 0.01 degrees."""
    nodded = BENCH.model_copy(update={"lidar": LidarPose(distance_m=0.2, yaw_deg=45.0, pitch_deg=1.0)})
    with pytest.raises(WallRefusedError, match=r"turned by \S+ degrees in yaw and \+1\.00 in pitch"):
        by_occluder(bench_seen(nodded), bare)


def test_an_origin_before_the_glass_does_not_move_the_occluder(seen: Seen) -> None:
    """The beams meet 4 sqrt(2) mm before the glass at 45 degrees: x and distance of the glass are 4 mm from theirs."""
    fit, facts = by_depth(seen, 0.204)
    assert facts["range_offset_cause"] == "origin"
    record = wall_record(fit, INTRINSICS, camera="sim", frames=10, created=date(2026, 1, 2), others=facts)
    told, _ = by_occluder(bench_seen(BENCH), MeasuredWall(record, None))
    assert told.occluder is not None
    assert told.occluder.x_m == pytest.approx(0.204, abs=2e-4)
    assert told.occluder.gap_m == pytest.approx(0.1, abs=0.002)
    assert told.occluder.x_std_m == pytest.approx(0.0005, rel=0.02)  # the tape's


def test_another_camera_is_noticed(bare: MeasuredWall) -> None:
    with pytest.raises(CalibrationError, match="measured at 160x120, the camera gives 80x60"):
        by_occluder(bench_seen(BENCH, RIG.pinhole.scaled(80, 60)), bare)


def test_another_device_is_refused_and_other_settings_are_noted(bare: MeasuredWall, seen: Seen) -> None:
    now = replace(bench_seen(BENCH), serial="f2", settings={"laser_power": 40.0})
    with pytest.raises(CalibrationError, match="measured with the camera f1, this is f2"):
        by_occluder(now, replace(bare, record=bare.record.model_copy(update={"serial": "f1"})))
    then = replace(seen, settings={"laser_power": 80.0}).reference(np.ones((120, 160), np.bool_))
    record, _ = by_occluder(now, replace(bare, reference=then))
    assert record.warnings[-1].endswith("laser_power was 80 and is 40")


def test_no_occluder_is_told(seen: Seen, bare: MeasuredWall) -> None:
    with pytest.raises(OccluderRefusedError, match="--occluder-x-m"):
        by_occluder(seen, bare)
