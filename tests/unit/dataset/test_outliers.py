"""Outliers lie outside training's range, varied rigs within theirs; doubt samples are cached and
follow their seeds.
"""

from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration import load_rig
from small_run import small_recipe

from nlos_cam.dataset import (
    HELD_OUT_OUTLIERS,
    SHAPE_OUTLIERS,
    TRAINING_OUTLIERS,
    Stimulus,
    outliers,
    uncertainty_samples,
)
from nlos_cam.dataset.outliers import (
    SLIGHT,
    WIDE,
    BenchSpread,
    draw_outlier,
    ordinary,
    vary_bench,
    vary_empty_bench,
)
from nlos_cam.dataset.plan import move_lidar
from nlos_cam.dataset.uncertainty_samples import (
    EMPTY,
    GENERIC,
    ORDINARY,
    SEEDS_PER_BENCH,
    _stimulus,
    make_samples,
)
from nlos_cam.objects import object_box
from nlos_cam.render import SensorModel

RIG = load_rig("paper-rig")
SENSOR = SensorModel()
BOX = object_box(RIG)
PLAIN = Stimulus(RIG, SENSOR)
SEEDS = range(6)


def made(name: str, seed: int) -> Stimulus:
    return draw_outlier(
        {**TRAINING_OUTLIERS, **HELD_OUT_OUTLIERS}[name], np.random.default_rng(seed), PLAIN
    )


def touches_edge(stimulus: Stimulus) -> bool:
    seen = np.isfinite(stimulus.depth_m)
    return bool(seen[[0, -1]].any() or seen[:, [0, -1]].any())


@pytest.mark.parametrize("name", [*TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS])
def test_outlier_shows_surface_before_wall_outside_by_its_own_measure_and_repeats_by_seed(
    name: str,
) -> None:
    for seed in SEEDS:
        one = made(name, seed)
        again = made(name, seed)
        np.testing.assert_array_equal(one.depth_m, again.depth_m)
        surface_m = one.depth_m[np.isfinite(one.depth_m)]
        assert surface_m.size >= outliers.MIN_PIXELS
        assert surface_m.min() > 0.0
        assert one.scene.rig == one.rig
        assert name not in OUTSIDE or OUTSIDE[name](one)


def test_outlier_kinds_to_learn_and_judge_differ_and_exclude_shapes_that_weights_saw() -> None:
    assert not set(TRAINING_OUTLIERS) & set(HELD_OUT_OUTLIERS)
    for kinds in (TRAINING_OUTLIERS, HELD_OUT_OUTLIERS):
        assert set(kinds) & SHAPE_OUTLIERS
        assert set(kinds) - SHAPE_OUTLIERS
    assert {*TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS} > SHAPE_OUTLIERS
    assert outliers.outliers_beside(0.0) == TRAINING_OUTLIERS
    learnt = set(outliers.outliers_beside(0.5))
    assert learnt == {
        "small",
        "large",
        "far",
        "near",
        "half out",
        "dim",
        "other rig",
        "other sensor",
    }


OUTSIDE: dict[str, Callable[[Stimulus], bool]] = {
    "small": lambda s: np.ptp(np.nonzero(np.isfinite(s.depth_m)), axis=1).max() + 1 < 64 / 2,
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


def test_ordinary_object_is_no_outlier_and_outlier_without_surface_is_drawn_again() -> None:
    for seed in SEEDS:
        stimulus = ordinary(np.random.default_rng(seed), PLAIN)
        assert (stimulus.rig, stimulus.sensor) == (RIG, SENSOR)
        for name in ("far", "near", "dim", "glossy", "other rig", "other sensor"):
            assert not OUTSIDE[name](stimulus)
    shy = Mock(side_effect=[PLAIN, PLAIN, ordinary(np.random.default_rng(0), PLAIN)])
    assert np.isfinite(draw_outlier(shy, np.random.default_rng(0), PLAIN).depth_m).any()
    assert shy.call_count == 3


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


def test_moved_rig_differs_in_lidar_pose_alone_and_empty_benches_are_plain_wide_or_without_occluder() -> (
    None
):
    other = move_lidar(RIG, 0.01, 2.0, -3.0)
    assert other.lidar.distance_m == pytest.approx(RIG.lidar.distance_m + 0.01)
    assert other.facing_deg == pytest.approx(47.0, abs=0.2)
    assert other.model_copy(update={"lidar": RIG.lidar}) == RIG
    benches = [vary_empty_bench(RIG, SENSOR, np.random.default_rng(seed)) for seed in range(200)]
    assert any(sensor == SENSOR for _, sensor in benches)
    assert any(abs(rig.lidar.distance_m - 0.2) > SLIGHT.place_m for rig, _ in benches)
    assert 5 < sum(rig.occluder is None for rig, _ in benches) < 50


def test_sample_shows_its_object_or_an_empty_bench_and_depends_on_its_seed_alone() -> None:
    empty, ordinary, plates = (
        make_samples(kind, range(2), RIG, SENSOR) for kind in (EMPTY, ORDINARY, "plates")
    )
    assert not empty.image.any()
    assert not empty.cells.any()
    for shown in (ordinary, plates):
        assert (shown.image > 0).any((1, 2)).all()
        assert (shown.cells > 50).all()
        assert ((np.abs(shown.depth_m - empty.depth_m[0]) > 0.02).sum((1, 2)) > 50).all()
    alone = make_samples(ORDINARY, [1], RIG, SENSOR)
    np.testing.assert_array_equal(alone.depth_m[0], ordinary.depth_m[1])
    np.testing.assert_array_equal(alone.intensity[0], ordinary.intensity[1])


def test_ordinary_and_half_of_outlier_benches_lie_slightly_off_and_kinds_share_no_bench_and_no_noise() -> (
    None
):
    """A shared bench would let a network tell outliers from ordinary objects."""
    seeds = 0, SEEDS_PER_BENCH - 1, SEEDS_PER_BENCH
    ordinary, plates = (
        [_stimulus(kind, seed, RIG, SENSOR).rig for seed in seeds] for kind in (ORDINARY, "plates")
    )
    assert [rig == RIG for rig in plates] == [True, True, False]
    assert RIG not in ordinary
    assert ordinary[0] == ordinary[1] != ordinary[2]
    kinds = [EMPTY, ORDINARY, *TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS]
    for of in range(3):
        assert len({uncertainty_samples._generator(kind, 3, of).bytes(8) for kind in kinds}) == len(
            kinds
        )
    slight = [
        _stimulus(kind, SEEDS_PER_BENCH, RIG, SENSOR) for kind in ("plates", "blobs", ORDINARY)
    ]
    assert len({stimulus.rig.checksum for stimulus in slight}) == 3
    assert len({stimulus.sensor.bare_wall_counts for stimulus in slight}) == 3


def test_usual_objects_are_as_many_as_outliers_with_generic_shapes_by_their_share() -> None:
    recipe = small_recipe(task="doubt", outliers=20, empties=9)
    for share, kinds in ((0.0, 17), (0.25, 8)):
        counts = uncertainty_samples.counts_of(recipe, share)
        assert counts[EMPTY] == 9
        assert sum(counts.values()) == 9 + kinds * 20 + kinds * 10
        assert counts.get(GENERIC, 0) == share * kinds * 10
    one, same = (make_samples(GENERIC, [SEEDS_PER_BENCH], RIG, SENSOR) for _ in range(2))
    np.testing.assert_array_equal(one.depth_m, same.depth_m)
    assert _stimulus(GENERIC, 0, RIG, SENSOR).rig != RIG


def test_samples_on_disk_makes_only_missing_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[tuple[str, int]]()

    def quick(kind: str, seeds: range, *_: object) -> uncertainty_samples.UncertaintySamples:
        made.append((kind, seeds.start))
        maps = np.zeros((len(seeds), 2, 2), np.float32)
        kinds = np.array([kind] * len(seeds))
        return uncertainty_samples.UncertaintySamples(
            maps, maps, maps.astype(np.float16), np.array(seeds, np.int32), kinds
        )

    monkeypatch.setattr(uncertainty_samples, "make_samples", quick)
    samples_on_disk = uncertainty_samples.samples_on_disk
    first = samples_on_disk(tmp_path, {EMPTY: 150}, 7, RIG, SENSOR)
    assert made == [(EMPTY, 7), (EMPTY, 107)]
    told = list[tuple[int, int]]()
    asked = {EMPTY: 150, "far": 20}
    both = samples_on_disk(tmp_path, asked, 7, RIG, SENSOR, on_progress=lambda *at: told.append(at))
    assert made[2:] == [("far", 7)]
    np.testing.assert_array_equal(both.cells[:150], first.cells)
    assert both.kind.tolist() == [EMPTY] * 150 + ["far"] * 20
    assert told == [(100, 170), (150, 170), (170, 170)]
    assert both.where(both.kind == "far").cells.tolist() == list(range(7, 27))
    damaged = next(tmp_path.glob("*-far-*.npz"))
    damaged.write_bytes(damaged.read_bytes()[:-40])
    samples_on_disk(tmp_path, asked, 7, RIG, SENSOR)
    assert made[3:] == [("far", 7)]
