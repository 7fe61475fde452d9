from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from threading import Event

import numpy as np
import pytest
from fake_wall import WallCamera
from nlos_calibration import load_rig
from nlos_calibration.arrays import Float32
from small_frames import ListViewer, sheet_network

from nlos_cam.frames import LidarMaps
from nlos_cam.live import run_live
from nlos_cam.objects import object_box, object_depth
from nlos_cam.reconstruct import CalibratedRig, PeriodicPhysicsCheck, Pipeline, check_reconstruction
from nlos_cam.reconstruct.physics_check import (
    Expected,
    PhysicsCheckResult,
    describe_failure,
    explain,
    fit_gain,
    log_warning,
    mean_cost,
)
from nlos_cam.render import Scene, Sensor, SensorModel, cast, render

SHAPE = 64, 80
GAIN = 1e5
RIGHT = np.broadcast_to(np.arange(80) >= 40, SHAPE)
WALL_M = np.broadcast_to(np.linspace(0.2, 0.6, 80), SHAPE)


ALL_WALL = np.ones(SHAPE, np.bool_)
NO_ECHO = Expected(
    np.full(SHAPE, np.nan), np.zeros(SHAPE), np.full(SHAPE, np.nan), np.zeros(SHAPE), ALL_WALL
)
"""Neither wall nor object."""


def expected_object(echo_m: float = 0.5, strength: float = 4.0) -> Expected:
    """Return a wall and, on the right half, an object's echo, `strength` times the wall's own."""
    direct = np.full(SHAPE, 3e-4)
    echo = np.where(RIGHT, strength * direct, 0.0)
    depth_m = np.where(echo > 0, echo_m + np.zeros(SHAPE), np.nan)
    return Expected(WALL_M, direct, depth_m, echo, ALL_WALL)


def maps_of(
    expected: Expected, *, noise_m: float = 0.0, albedo: float = 1.0, gain: float = GAIN
) -> LidarMaps:
    depth_m, intensity = expected.noiseless_maps(albedo, gain)
    noise = np.random.default_rng(0).normal(0, 1, SHAPE).astype(np.float32)
    return LidarMaps(depth_m + np.float32(noise_m) * noise, intensity, np.isfinite(depth_m))


def score(seen: LidarMaps, expected: Expected) -> float:
    return explain(seen, expected, expected.bare).score


def test_score_of_expected_maps_is_0_but_for_noise() -> None:
    scene = expected_object()

    assert score(maps_of(scene), scene) == pytest.approx(0.0, abs=1e-6)
    assert score(maps_of(scene, noise_m=1e-4), scene) < 0.1
    assert score(maps_of(scene.bare, noise_m=1e-4), scene.bare) < 0.05


def test_score_of_an_empty_bench_for_an_object_is_1() -> None:
    scene = expected_object()
    assert score(maps_of(scene), scene.bare) == 1.0


def test_score_of_maps_without_any_return() -> None:
    assert score(maps_of(NO_ECHO), NO_ECHO) == 0.0
    assert score(maps_of(NO_ECHO), expected_object()) == pytest.approx(1.0)


def test_score_of_an_object_that_is_not_there_is_above_1() -> None:
    bare = maps_of(expected_object().bare, noise_m=1e-4)
    assert score(bare, expected_object(strength=20.0)) > 1.0


def test_score_rises_with_the_distance_from_the_object() -> None:
    maps = maps_of(expected_object(0.5))
    scores = [score(maps, expected_object(0.5 + off_m)) for off_m in (0.0, 0.005, 0.01, 0.03, 0.1)]

    assert scores[0] <= scores[1] < scores[2] < scores[3] < scores[4]
    assert scores[-1] > 0.9


@pytest.mark.parametrize("albedo", [0.75, 1.0, (4 / 3) ** 0.5])
def test_explain_fits_the_albedo(albedo: float) -> None:
    scene = expected_object()
    best = explain(maps_of(scene, albedo=albedo), scene, scene.bare)

    assert best.albedo == pytest.approx(albedo, rel=1e-6)
    assert best.score == pytest.approx(0.0, abs=1e-6)


def test_explain_fits_the_gain() -> None:
    scene = expected_object()
    maps = maps_of(scene)
    dimmed = replace(maps, intensity=maps.intensity * np.float32(0.25))
    best = explain(dimmed, scene, scene.bare)

    assert best.gain == pytest.approx(0.25 * GAIN, rel=1e-5)
    assert best.score == pytest.approx(explain(maps, scene, scene.bare).score, abs=1e-6)


def test_fitted_gain_uses_the_wall_where_it_is_visible() -> None:
    seen = maps_of(expected_object(strength=40.0), gain=1e4)

    assert fit_gain(seen, expected_object().bare) == pytest.approx(1e4, rel=1e-5)

    far = replace(seen, depth_m=seen.depth_m + np.float32(0.2))

    assert fit_gain(far, expected_object().bare) > 1e4
    assert fit_gain(replace(seen, valid=np.zeros(SHAPE, np.bool_)), expected_object().bare) == 1.0


def test_mean_cost_lets_equally_strong_echoes_swap() -> None:
    bare = maps_of(expected_object().bare)

    assert mean_cost(bare, expected_object(strength=1.1), GAIN, 1.0) < 0.05
    assert mean_cost(bare, expected_object(strength=10.0), GAIN, 1.0) > 0.4


def test_mean_cost_counts_cells_that_wrongly_return_or_do_not() -> None:
    wall = expected_object().bare
    direct = np.where(RIGHT, 0.0, wall.direct)
    half = replace(wall, direct=direct, direct_m=np.where(RIGHT, np.nan, wall.direct_m))

    assert mean_cost(maps_of(wall), half, GAIN, 1.0) == pytest.approx(0.5, abs=1e-3)
    assert mean_cost(maps_of(half), wall, GAIN, 1.0) == pytest.approx(0.5, abs=1e-3)
    assert mean_cost(maps_of(half), half, GAIN, 1.0) == pytest.approx(0.0, abs=1e-6)


def test_saturated_cell_explains_any_more_light() -> None:
    bright = expected_object(strength=1000.0)
    maps = maps_of(bright)

    assert maps.intensity.max() == 255
    assert mean_cost(maps, bright, GAIN, 1.0) == pytest.approx(0.0, abs=1e-6)
    assert mean_cost(maps, expected_object(strength=1.5), GAIN, 1.0) > 0.1


RIG = load_rig("paper-rig")
EMPTY = np.full((64, 64), np.nan, np.float32)
SEEDS = range(20_000_100, 20_000_104)


@cache
def hidden(seed: int) -> Float32:
    return object_depth(seed, object_box(RIG))[1]


@cache
def seen(seed: int | None, noise: int = 0) -> LidarMaps:
    """What a lidar gives of an object, or of the bare bench, with the noise of the 60 pixels that
    make a cell.
    """
    rendering = render(Scene(RIG, None if seed is None else hidden(seed)), "standard")
    generator = np.random.default_rng(noise)
    depth_m = rendering.depth_m + generator.normal(0, 1e-4, (64, 80)).astype(np.float32)
    counts = rendering.intensity * 1.25e5 + generator.normal(0, 0.2, (64, 80)).astype(np.float32)
    return LidarMaps(depth_m, np.maximum(counts, 0), np.isfinite(depth_m))


@pytest.mark.slow
def test_check_scores_the_true_object_best() -> None:
    for seed in SEEDS:
        scores = {
            other: check_reconstruction(seen(seed), hidden(other), RIG, accuracy="draft").score
            for other in SEEDS
        }
        own = scores.pop(seed)
        assert own < 0.5 * min(scores.values())


def test_check_explains_the_true_object_to_within_noise() -> None:
    found = check_reconstruction(seen(SEEDS[0]), hidden(SEEDS[0]), RIG)

    assert found.score < 0.05
    assert np.nanquantile(np.abs(found.residual_depth_m), 0.95) < 2e-3
    assert np.nanquantile(np.abs(found.residual_intensity), 0.95) < 3
    assert found.residual_depth_m.dtype == found.residual_intensity.dtype == np.float32


def test_check_takes_its_time_from_the_clock() -> None:
    ticks = iter([5.0, 7.5])
    found = check_reconstruction(seen(None), EMPTY, RIG, clock=lambda: next(ticks))

    assert found.seconds == 2.5


def test_check_finds_an_object_where_none_is() -> None:
    assert check_reconstruction(seen(None), hidden(SEEDS[0]), RIG).score > 1.0


@pytest.fixture
def rendered_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be rendered but the bare bench, which was."""
    check_reconstruction(seen(None), EMPTY, RIG)
    for module in ("bare_bench", "physics_check"):
        path = f"nlos_cam.reconstruct.{module}.render"
        monkeypatch.setattr(path, lambda *_: pytest.fail("rendered again"))


@pytest.mark.usefixtures("rendered_bench")
def test_bare_bench_explains_itself_and_is_rendered_once() -> None:
    assert check_reconstruction(seen(None), EMPTY, RIG).score < 0.05


@pytest.mark.parametrize("reflects", [0.05, 0.2, 4.0])
def test_occluder_of_any_reflectance_leaves_the_score(reflects: float) -> None:
    cells = cast(RIG, RIG.pinhole.scaled(80, 64)).on_wall.reshape(SHAPE)
    factor = np.where(cells, 1, reflects).astype(np.float32)
    empty, full = seen(None), seen(SEEDS[0])
    dark = [replace(maps, intensity=factor * maps.intensity) for maps in (empty, full)]

    assert check_reconstruction(dark[0], EMPTY, RIG).score < 0.05
    assert check_reconstruction(dark[1], hidden(SEEDS[0]), RIG).score < 0.05


def test_noise_is_that_of_a_wall_as_bright_as_measured() -> None:
    """An occluder nearer than the wall is no measure of its light."""
    pose = RIG.lidar.model_copy(update={"distance_m": 0.3, "yaw_deg": 58.0})
    far = RIG.model_copy(update={"lidar": pose})
    sensor = Sensor(far, SensorModel(bare_wall_counts=10.0))
    maps = sensor.maps(render(Scene(far)).multi, np.random.default_rng(1))

    assert check_reconstruction(maps, None, far).score < 0.01


def test_bare_bench_does_not_explain_an_object() -> None:
    assert check_reconstruction(seen(SEEDS[0]), EMPTY, RIG).score == 1.0


@pytest.mark.usefixtures("rendered_bench")
def test_maps_without_returns_have_no_residuals() -> None:
    nan_m = np.full(SHAPE, np.nan, np.float32)
    dark = np.zeros(SHAPE, np.float32)
    found = check_reconstruction(LidarMaps(nan_m, dark, dark > 0), EMPTY, RIG)

    assert found.score == 1.0
    assert np.isnan(found.residual_depth_m).all()


def test_check_works_on_a_rig_without_object_box() -> None:
    bare = load_rig("bare-wall")
    rendering = render(Scene(bare))
    maps = LidarMaps(
        rendering.depth_m, rendering.intensity * np.float32(1e5), np.isfinite(rendering.depth_m)
    )

    assert check_reconstruction(maps, None, bare).score < 1e-3
    assert check_reconstruction(maps, hidden(SEEDS[0]), bare).score < 1e-3


def checks_of(seeds: Sequence[int]) -> dict[int, PhysicsCheckResult]:
    """Return the checks of objects, in this order, against the first one's shape."""
    checks = PeriodicPhysicsCheck(RIG, every=1, accuracy="draft")
    found = {}
    for seed in seeds:
        checks.offer(seed, seen(seed), hidden(SEEDS[0]))
        found[seed] = checks.newest
    return found


def test_periodic_check_is_independent_of_earlier_frames() -> None:
    forwards = checks_of(SEEDS)
    backwards = checks_of(SEEDS[::-1])
    for seed, one in forwards.items():
        other = backwards[seed]
        assert one.frame_number == seed
        assert one.score == other.score
        np.testing.assert_array_equal(one.residual_depth_m, other.residual_depth_m)


def test_periodic_check_reports_a_failure_once(caplog: pytest.LogCaptureFixture) -> None:
    behind_the_wall = np.full((64, 64), -1.0, np.float32)
    checks = PeriodicPhysicsCheck(RIG, every=1)
    for number, depth_m in enumerate([behind_the_wall, behind_the_wall, EMPTY]):
        checks.offer(number, seen(None), depth_m)
    (message,) = caplog.messages

    assert "frame 0" in message
    assert checks.newest.frame_number == 2

    log_warning(describe_failure(7, "SceneError: 100 % wrong"))

    assert "SceneError: 100 % wrong" in caplog.messages[1]


def test_check_compares_with_the_bench_that_is_set() -> None:
    checks = PeriodicPhysicsCheck(RIG, every=1, accuracy="draft")
    pipeline = Pipeline(CalibratedRig(RIG), sheet_network, checks=checks)
    other = load_rig("bare-wall")
    pipeline.bench = CalibratedRig(other)
    checks.offer(0, seen(None), EMPTY)

    assert checks.newest.score == check_reconstruction(seen(None), EMPTY, other).score
    assert checks.newest.score != check_reconstruction(seen(None), EMPTY, RIG).score


def test_live_loop_shows_the_newest_check_with_each_frame() -> None:
    viewer = ListViewer()
    checks = PeriodicPhysicsCheck(RIG, every=2, accuracy="draft")
    pipeline = Pipeline(CalibratedRig(RIG), sheet_network, checks=checks)
    run_live(WallCamera(5, period_s=0.0), pipeline, viewer, stop=Event(), recorded=True)

    assert [moment.result.check.frame_number for moment in viewer.moments] == [0, 0, 2, 2, 4]
