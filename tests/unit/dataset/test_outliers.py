"""Outliers lie outside the range of training objects by their own measure; vary_bench rigs stay within their spread."""

from collections.abc import Callable

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.dataset import (
    HELD_OUT_OUTLIERS,
    SHAPE_OUTLIERS,
    TRAINING_OUTLIERS,
    Stimulus,
    draw_outlier,
    outliers_beside,
)
from nlos_cam.dataset.outliers import MIN_PIXELS, SLIGHT, WIDE, BenchSpread, ordinary, vary_bench, vary_empty_bench
from nlos_cam.dataset.plan import move_lidar
from nlos_cam.objects import object_box
from nlos_cam.render import SensorModel

RIG, SENSOR = load_rig("paper-rig"), SensorModel()
BOX = object_box(RIG)
PLAIN = Stimulus(RIG, SENSOR)
SEEDS = range(6)


def made(name: str, seed: int) -> Stimulus:
    return draw_outlier({**TRAINING_OUTLIERS, **HELD_OUT_OUTLIERS}[name], np.random.default_rng(seed), PLAIN)


def width_m(depth_m: np.ndarray) -> float:
    rows, columns = np.nonzero(np.isfinite(depth_m))
    return float(max(np.ptp(rows), np.ptp(columns)) + 1) * 0.25 / 64


def touches_edge(stimulus: Stimulus) -> bool:
    seen = np.isfinite(stimulus.depth_m)
    return bool(seen[[0, -1]].any() or seen[:, [0, -1]].any())


@pytest.mark.parametrize("name", [*TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS])
def test_outlier_shows_surface_before_wall_and_repeats_by_seed(name: str) -> None:
    for seed in SEEDS:
        one, again = made(name, seed), made(name, seed)
        np.testing.assert_array_equal(one.depth_m, again.depth_m)
        surface_m = one.depth_m[np.isfinite(one.depth_m)]
        assert surface_m.size >= MIN_PIXELS
        assert surface_m.min() > 0.0
        assert one.scene.rig == one.rig


def test_outlier_kinds_to_learn_and_to_judge_differ() -> None:
    assert not set(TRAINING_OUTLIERS) & set(HELD_OUT_OUTLIERS)
    for kinds in (TRAINING_OUTLIERS, HELD_OUT_OUTLIERS):
        assert set(kinds) & SHAPE_OUTLIERS
        assert set(kinds) - SHAPE_OUTLIERS
    assert {*TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS} > SHAPE_OUTLIERS


def test_shapes_are_no_outliers_to_weights_that_saw_generic_ones() -> None:
    assert outliers_beside(0.0) == TRAINING_OUTLIERS
    learnt = set(outliers_beside(0.5))
    assert not learnt & (SHAPE_OUTLIERS | {"several", "tilted"})
    assert learnt == {"small", "large", "far", "near", "half out", "dim", "other rig", "other sensor"}


OUTSIDE: dict[str, Callable[[Stimulus], bool]] = {
    "small": lambda s: width_m(s.depth_m) < 0.5 * 0.25,
    "large": touches_edge,
    "far": lambda s: float(np.nanmin(s.depth_m)) > BOX.z_near_m + 0.119,
    "near": lambda s: float(np.nanmin(s.depth_m)) < BOX.z_near_m,
    "dim": lambda s: float(np.max(s.surface.albedo)) <= 0.4,
    "two tone": lambda s: len(np.unique(s.surface.albedo)) == 2,
    "glossy": lambda s: s.surface.brdf is not None,
    "other rig": lambda s: abs(s.rig.lidar.distance_m - RIG.lidar.distance_m) >= 0.015,
    "other sensor": lambda s: not 0.65 < s.sensor.bare_wall_counts / 48.0 < 1.6,
    "half out": touches_edge,
    "noise sheet": lambda s: float(np.nanstd(s.depth_m)) > 0.07,
}


@pytest.mark.parametrize("name", list(OUTSIDE))
def test_outlier_is_outside_by_its_own_measure(name: str) -> None:
    assert all(OUTSIDE[name](made(name, seed)) for seed in SEEDS)


def test_ordinary_object_is_no_outlier() -> None:
    for seed in SEEDS:
        stimulus = ordinary(np.random.default_rng(seed), PLAIN)
        assert (stimulus.rig, stimulus.sensor) == (RIG, SENSOR)
        for name in ("far", "near", "dim", "glossy", "other rig", "other sensor"):
            assert not OUTSIDE[name](stimulus)


def test_outlier_without_surface_is_drawn_again() -> None:
    tries = list[int]()

    def shy(generator: np.random.Generator, stimulus: Stimulus) -> Stimulus:
        tries.append(1)
        seen = ordinary(generator, stimulus)
        return stimulus if len(tries) < 3 else seen

    assert np.isfinite(draw_outlier(shy, np.random.default_rng(0), PLAIN).depth_m).any()
    assert len(tries) == 3


def test_moved_rig_differs_in_lidar_pose_alone() -> None:
    other = move_lidar(RIG, 0.01, 2.0, -3.0)
    assert other.lidar.distance_m == pytest.approx(RIG.lidar.distance_m + 0.01)
    assert other.facing_deg == pytest.approx(47.0, abs=0.2)
    assert other.model_copy(update={"lidar": RIG.lidar}) == RIG


@pytest.mark.parametrize("spread", [BenchSpread(*(0.0,) * len(SLIGHT)), SLIGHT, WIDE])
def test_varied_rig_lies_within_its_spread(spread: BenchSpread) -> None:
    for seed in range(50):
        rig, sensor = vary_bench(RIG, SENSOR, spread, np.random.default_rng(seed))
        assert abs(rig.lidar.distance_m - RIG.lidar.distance_m) <= spread.place_m
        assert max(abs(rig.lidar.yaw_deg - 45.0), abs(rig.lidar.pitch_deg)) <= spread.angle_deg
        assert abs(np.log(sensor.bare_wall_counts / SENSOR.bare_wall_counts)) <= spread.gain + 1e-9
        assert sensor.ambient_counts <= spread.ambient_counts
        assert sensor.ripple_m <= spread.ripple_m
        assert any(spread) or (rig, sensor) == (RIG, SENSOR)


def test_varied_empty_benches_are_plain_wide_or_without_occluder() -> None:
    benches = [vary_empty_bench(RIG, SENSOR, np.random.default_rng(seed)) for seed in range(200)]
    assert any(sensor == SENSOR for _, sensor in benches)
    assert any(abs(rig.lidar.distance_m - 0.2) > SLIGHT.place_m for rig, _ in benches)
    assert 5 < sum(rig.occluder is None for rig, _ in benches) < 50
