from functools import cache
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from fake_wall import WallCamera
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import load_rig

from nlos_cam.frames import LidarMaps
from nlos_cam.live.loop import run_live
from nlos_cam.live.replay import REPORT, RESULT, replay_recording
from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.placement import object_depth
from nlos_cam.reconstruct import physics_check
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.physics_check import EveryFrames, check
from nlos_cam.reconstruct.pipeline import Pipeline
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.view.viewer import Moment, NullViewer

RIG = load_rig("paper-rig")
EMPTY = np.full((64, 64), np.nan, np.float32)
SEEDS = range(20_000_100, 20_000_104)


def network(*_: np.ndarray) -> np.ndarray:
    """Shows a sheet, whatever it is shown."""
    return np.full((1, 64, 64), 0.5, np.float32)


@cache
def hidden(seed: int) -> Float32:
    return object_depth(seed, object_box(RIG))[1]


@cache
def seen(seed: int | None, noise: int = 0) -> LidarMaps:
    """What a lidar gives of an object, or of the bare bench, with the noise of the 60 pixels that make a cell."""
    rendering = render(Scene(RIG, None if seed is None else hidden(seed)), "standard")
    generator = np.random.default_rng(noise)
    depth_m = rendering.depth_m + generator.normal(0, 1e-4, (64, 80)).astype(np.float32)
    counts = rendering.intensity * 1.25e5 + generator.normal(0, 0.2, (64, 80)).astype(np.float32)
    return LidarMaps(depth_m, np.maximum(counts, 0), np.isfinite(depth_m))


def test_the_true_object_explains_the_maps_better_than_any_other() -> None:
    for seed in SEEDS:
        scores = {other: check(seen(seed), hidden(other), RIG, accuracy="draft").score for other in SEEDS}
        assert min(scores, key=lambda other: scores[other]) == seed
        assert scores[seed] < 0.5 * min(score for other, score in scores.items() if other != seed)


def test_the_finer_stop_explains_the_true_object_to_within_noise() -> None:
    found = check(seen(SEEDS[0]), hidden(SEEDS[0]), RIG)
    assert found.score < 0.05
    assert np.nanquantile(np.abs(found.residual_depth_m), 0.95) < 2e-3
    assert np.nanquantile(np.abs(found.residual_intensity), 0.95) < 3
    assert found.residual_depth_m.dtype == found.residual_intensity.dtype == np.float32


def test_nothing_shown_is_checked_as_the_bare_bench() -> None:
    assert check(seen(None), EMPTY, RIG).score < 0.05
    assert check(seen(None), hidden(SEEDS[0]), RIG).score > 1.0
    assert check(seen(SEEDS[0]), EMPTY, RIG).score == 1.0


def test_a_bench_without_an_object_box_is_checked_too() -> None:
    bare = load_rig("bare-wall")
    rendering = render(Scene(bare))
    maps = LidarMaps(rendering.depth_m, rendering.intensity * np.float32(1e5), np.isfinite(rendering.depth_m))
    assert check(maps, None, bare).score < 1e-3
    assert check(maps, hidden(SEEDS[0]), bare).score < 1e-3


def test_maps_without_any_return_are_not_explained_and_have_no_residual_depth() -> None:
    dark = LidarMaps(
        np.full((64, 80), np.nan, np.float32), np.zeros((64, 80), np.float32), np.zeros((64, 80), np.bool_)
    )
    found = check(dark, EMPTY, RIG)
    assert found.score == 1.0
    assert np.isnan(found.residual_depth_m).all()


def test_how_long_it_took_is_by_the_clock_that_is_given() -> None:
    assert check(seen(None), EMPTY, RIG, clock=iter([5.0, 7.5]).__next__).seconds == 2.5


def test_a_check_does_not_depend_on_the_frames_before_it() -> None:
    forwards, backwards = {}, {}
    for found, order in ((forwards, SEEDS), (backwards, SEEDS[::-1])):
        checks = EveryFrames(RIG, every=1, accuracy="draft")
        for seed in order:
            checks.offer(seed, seen(seed), hidden(SEEDS[0]))
            found[seed] = checks.newest
    for seed in SEEDS:
        assert (forwards[seed].frame_number, forwards[seed].score) == (seed, backwards[seed].score)
        np.testing.assert_array_equal(forwards[seed].residual_depth_m, backwards[seed].residual_depth_m)


def test_every_so_many_frames_are_checked() -> None:
    numbers = []
    with EveryFrames(RIG, every=3) as checks:
        for number in range(8):
            checks.offer(number, seen(None), EMPTY)
            numbers.append(checks.newest.frame_number if checks.newest else None)
    assert numbers == [0, 0, 0, 3, 3, 3, 6, 6]


def test_a_check_that_fails_is_told_once_and_frames_go_on() -> None:
    told, behind_the_wall = [], np.full((64, 64), -1.0, np.float32)
    checks = EveryFrames(RIG, every=1, on_error=told.append)
    for number, depth_m in enumerate([behind_the_wall, behind_the_wall, EMPTY]):
        checks.offer(number, seen(None), depth_m)
    assert len(told) == 1
    assert "frame 0" in told[0]
    assert "behind the wall" in told[0]
    assert checks.newest is not None
    assert checks.newest.frame_number == 2


def test_a_replay_writes_its_checks_and_the_same_bits_each_time(tmp_path: Path) -> None:
    for name in ("a", "b"):
        processing = Pipeline(CalibratedRig(RIG), network, checks=EveryFrames(RIG, every=3, accuracy="draft"))
        replay_recording(WallCamera(7), processing, tmp_path / name, stop=Event())
    for file in (RESULT, REPORT):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    with np.load(tmp_path / "a" / RESULT) as result:
        assert result["check_frame_number"].tolist() == [0, 3, 6]
        assert result["check_score"].shape == (3,)
        assert (result["check_score"] > 0.5).all()
    assert "physics check of 3 frames" in (tmp_path / "a" / REPORT).read_text()


def test_a_replay_without_checks_tells_of_none(tmp_path: Path) -> None:
    replay_recording(WallCamera(2), Pipeline(CalibratedRig(RIG), network), tmp_path / "out", stop=Event())
    with np.load(tmp_path / "out" / RESULT) as result:
        assert result["check_score"].size == result["check_frame_number"].size == 0
    assert "physics" not in (tmp_path / "out" / REPORT).read_text()


def test_what_comes_back_from_the_bare_bench_is_rendered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    check(seen(None), EMPTY, RIG)
    monkeypatch.setattr(physics_check, "render", lambda *_: pytest.fail("rendered again"))
    check(seen(None), EMPTY, RIG)


def test_a_live_loop_shows_the_newest_check_with_each_frame() -> None:
    shown = list[int]()

    class Viewer(NullViewer):
        def show(self, moment: Moment) -> None:
            assert moment.check is not None
            shown.append(moment.check.frame_number)

    processing = Pipeline(CalibratedRig(RIG), network, checks=EveryFrames(RIG, every=2, accuracy="draft"))
    run_live(WallCamera(5, period_s=0.0), processing, Viewer(), stop=Event(), recorded=True)
    assert shown == [0, 0, 2, 2, 4]
