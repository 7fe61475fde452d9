import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count as count_up
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import RIG, WallCamera, measured_wall, wall_frame
from nlos_calibration.errors import CalibrationError

from nlos_cam.frames import maps_from_frame
from nlos_cam.live.frame_queue import FrameReader
from nlos_cam.live.loop import FRAMES_TOGETHER, MAX_BATCHES_AHEAD, iterate_batched, iterate_results, with_telemetry
from nlos_cam.reconstruct.bench import BenchObservation, CalibratedRig
from nlos_cam.reconstruct.network import Clock
from nlos_cam.reconstruct.physics_check import EveryFrames, PhysicsCheckResult
from nlos_cam.reconstruct.pipeline import FrameResult, Pipeline, signs_of
from nlos_cam.reconstruct.verdict import FrameConditions, Verdict


def network(*_: np.ndarray) -> np.ndarray:
    return np.full((1, 64, 64), 0.5, np.float32)


def all_steps(processing: Pipeline, camera: WallCamera, clock: Clock = lambda: 0.0) -> list[FrameResult]:
    frames, thermometer = with_telemetry(camera, camera)
    with FrameReader(frames, keeps_all=True, stop=Event(), clock=lambda: 0.0) as reader:
        return list(iterate_results(reader, processing, clock, thermometer=thermometer))


def test_every_stage_is_timed_with_the_clock_it_is_given() -> None:
    ticks = iter(range(10_000))
    done = all_steps(Pipeline(CalibratedRig(RIG), network), WallCamera(3), lambda: float(next(ticks)))
    assert [step.frame.frame_number for step in done] == [0, 1, 2]
    for step in done:
        stages_s = dict(step.stages_s)
        assert stages_s.pop("queue") > (step.arrived_s or 0.0) == 0.0
        assert stages_s == {"wait": 1.0, "maps": 1.0, "bench": 1.0, "network": 1.0}


def test_networks_eat_the_mean_of_raw_maps_or_of_their_difference(tmp_path: Path) -> None:
    bench, eaten = CalibratedRig(RIG, measured_wall(tmp_path)), list[np.ndarray]()

    def noting(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
        eaten.append(depth_m[0])
        return network()

    for eats_difference in (False, True):
        done = all_steps(Pipeline(bench, noting, eats_difference=eats_difference, average=4), WallCamera(6))
    mean_m = np.mean([wall_frame(number).depth_m for number in range(2, 6)], axis=0)
    assert bench.reference is not None
    np.testing.assert_allclose(eaten[5], mean_m, atol=1e-6)
    np.testing.assert_allclose(eaten[11], mean_m - bench.reference.map_depth_m, atol=1e-6)
    assert done[5].frame.frame_number == 5
    assert done[5].difference is not None
    np.testing.assert_array_equal(done[5].difference.depth_m, eaten[11])


@pytest.mark.parametrize("offset_m", [0.0, 0.0045])
def test_raw_maps_are_corrected_by_the_measured_offset(tmp_path: Path, offset_m: float) -> None:
    measured, eaten = measured_wall(tmp_path), list[np.ndarray]()
    measured = replace(measured, record=measured.record.model_copy(update={"range_offset_m": offset_m}))

    def noting(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
        eaten.append(depth_m[0])
        return network()

    (step,) = all_steps(Pipeline(CalibratedRig(RIG, measured), noting), WallCamera(1))
    np.testing.assert_array_equal(eaten[0], step.maps.depth_m + np.float32(offset_m))


def test_networks_that_eat_difference_maps_need_a_reference() -> None:
    with pytest.raises(CalibrationError, match="these weights eat difference maps: give --wall with a reference"):
        Pipeline(CalibratedRig(RIG), network, eats_difference=True)


def test_what_drifts_is_looked_for_in_the_frame_and_not_in_the_mean(tmp_path: Path) -> None:
    processing = Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), network, average=1000)
    done = all_steps(processing, WallCamera(100, moved=range(50, 100)))
    assert not any(step.warnings for step in done[:50])
    assert done[-1].warnings


def test_a_temperature_is_warned_of_from_the_frame_on_that_it_was_read_at(tmp_path: Path) -> None:
    bench = CalibratedRig(RIG, measured_wall(tmp_path))
    done = all_steps(Pipeline(bench, network), WallCamera(3, celsius=80.0))
    assert all("ldd_temperature is 80 degrees" in "".join(step.warnings) for step in done)


def test_a_camera_is_asked_from_time_to_time_also_where_only_the_view_tells_its_temperature(tmp_path: Path) -> None:
    asked = {}
    for known in (None, measured_wall(tmp_path)):
        camera = WallCamera(25, period_s=1.0)
        all_steps(Pipeline(CalibratedRig(RIG, known), network), camera)
        asked[known is not None] = camera.asked
    assert asked == {False: 3, True: 3}


def ahead(processing: Pipeline, camera: WallCamera) -> list[FrameResult]:
    frames, thermometer = with_telemetry(camera, camera)
    with FrameReader(frames, keeps_all=True, stop=Event(), clock=lambda: 0.0) as reader, processing.checks:
        return list(iterate_batched(reader, processing, lambda: 0.0, thermometer))


CALLS = count_up()


def looking(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Shows what it eats; every other call takes longer, so that those that come side by side end out of order."""
    time.sleep(0.02 * (next(CALLS) % 2 == 0))
    return np.clip(np.nan_to_num(depth_m[:, :, :64]) + 0.5, 0.0, 1.0)


@pytest.mark.parametrize("count", [0, 1, FRAMES_TOGETHER, FRAMES_TOGETHER * (MAX_BATCHES_AHEAD + 3) + 3])
def test_steps_that_are_worked_on_together_are_those_worked_on_in_turn(tmp_path: Path, count: int) -> None:
    def processing() -> Pipeline:
        bench, checks = CalibratedRig(RIG, measured_wall(tmp_path)), EveryFrames(RIG, every=5, accuracy="draft")
        return Pipeline(bench, looking, average=3, doubter=FakeDoubter(), checks=checks)

    in_turn = all_steps(processing(), WallCamera(count, moved=range(count // 2)))
    together = ahead(processing(), WallCamera(count, moved=range(count // 2)))
    assert [step.frame.frame_number for step in together] == list(range(count))
    for one, other in zip(in_turn, together, strict=True):
        assert (one.verdict, one.warnings, one.arrived_s) == (other.verdict, other.warnings, other.arrived_s)
        assert one.check is not None
        assert other.check is not None
        assert (one.check.frame_number, one.check.score) == (other.check.frame_number, other.check.score)
        np.testing.assert_array_equal(one.maps.depth_m, other.maps.depth_m)
        np.testing.assert_array_equal(one.reconstruction.depth_m, other.reconstruction.depth_m)
        assert one.difference is not None
        assert other.difference is not None
        np.testing.assert_array_equal(one.difference.depth_m, other.difference.depth_m)


def test_frames_worked_on_together_share_the_networks_time() -> None:
    ticks = iter(range(10_000))
    with FrameReader(WallCamera(4), keeps_all=True, stop=Event(), clock=lambda: 0.0) as reader:
        done = list(iterate_batched(reader, Pipeline(CalibratedRig(RIG), network), lambda: float(next(ticks))))
    assert len(done) == FRAMES_TOGETHER == 4
    (share_s,) = {step.stages_s["network"] for step in done}
    assert share_s in {ticks / 4 for ticks in range(1, 100)}


def test_what_one_of_many_frames_leads_to_is_raised() -> None:
    odd_m = maps_from_frame(wall_frame(9)).depth_m

    def failing(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
        if any(np.array_equal(one_m, odd_m, equal_nan=True) for one_m in depth_m):
            raise ZeroDivisionError("an odd frame")
        return network()

    with pytest.raises(ZeroDivisionError, match="an odd frame"):
        ahead(Pipeline(CalibratedRig(RIG), failing), WallCamera(40))


def failing_at(number: int) -> Iterator[np.ndarray]:
    """Images of a network that fails on one of its frames, counted from 0."""
    for count in range(10_000):
        if count == number:
            raise ZeroDivisionError("an odd frame")
        yield network()


def test_a_failure_is_raised_unless_somebody_takes_it() -> None:
    images = failing_at(3)
    with pytest.raises(ZeroDivisionError, match="an odd frame"):
        all_steps(Pipeline(CalibratedRig(RIG), lambda *_: next(images)), WallCamera(9))


def test_where_nothing_is_hidden_a_step_shows_nothing_and_says_so() -> None:
    doubter = FakeDoubter(lambda *_: (0.9, 0.0))
    done = all_steps(Pipeline(CalibratedRig(RIG), network, doubter=doubter), WallCamera(3))
    assert [step.verdict for step in done] == [Verdict.NOTHING] * 3
    assert not any(step.reconstruction.shows for step in done)


def test_where_something_is_it_is_shown_with_its_uncertainty() -> None:
    (step,) = all_steps(Pipeline(CalibratedRig(RIG), network, doubter=FakeDoubter()), WallCamera(1))
    assert step.verdict == Verdict.SEEN
    assert step.reconstruction.shows
    assert step.reconstruction.uncertainty_m is not None


def test_doubt_is_of_what_the_networks_ate(tmp_path: Path) -> None:
    bench, eaten, doubter = CalibratedRig(RIG, measured_wall(tmp_path)), list[np.ndarray](), FakeDoubter()

    def noting(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
        eaten.append(depth_m)
        return network()

    all_steps(Pipeline(bench, noting, eats_difference=True, average=3, doubter=doubter), WallCamera(4))
    for mine, its in zip(doubter.asked, eaten, strict=True):
        np.testing.assert_array_equal(mine[0], its)


def test_a_lidar_that_moved_is_the_verdict_whatever_the_networks_say(tmp_path: Path) -> None:
    doubter = FakeDoubter(lambda *_: (0.0, 0.9))
    processing = Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), network, doubter=doubter)
    done = all_steps(processing, WallCamera(100, moved=range(50, 100)))
    assert {step.verdict for step in done[:50]} == {Verdict.OUTSIDE}
    assert done[-1].verdict == Verdict.WALL_MOVED


@pytest.mark.parametrize(
    ("change", "signs"),
    [
        ({}, FrameConditions()),
        ({"depth_m": np.full((64, 80), np.nan, np.float32)}, FrameConditions(invalid=True)),
        (
            {"depth_m": np.where(np.arange(80) < 40, np.float32(0.3), np.nan) * np.ones((64, 1))},
            FrameConditions(invalid=True),
        ),
        ({"ir": np.full((64, 80), 255, np.uint8)}, FrameConditions(saturated=True)),
    ],
)
def test_what_is_amiss_with_a_frame_is_a_sign(change: dict[str, np.ndarray], signs: FrameConditions) -> None:
    whole = replace(wall_frame(0), depth_m=np.full((64, 80), 0.3, np.float32))
    assert signs_of(replace(whole, **change), BenchObservation(None, ()), None) == signs
    check = PhysicsCheckResult(
        0, np.zeros((64, 80), np.float32), np.zeros((64, 80), np.float32), score=1.0, seconds=0.0
    )
    assert signs_of(replace(whole, **change), BenchObservation(None, ()), check) == replace(signs, check=check)
