"""Outliers lie outside training's range, varied rigs within theirs; uncertainty samples are
cached and follow their seeds.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig
from nlos_models import load_record, shipped_folder
from nlos_models.training import MapSet
from small_run import small_recipe

from nlos_cam.dataset import (
    HELD_OUT_OUTLIERS,
    SHAPE_OUTLIERS,
    TRAINING_OUTLIERS,
    RigRange,
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
from nlos_cam.dataset.plan import DatasetPlan, move_lidar
from nlos_cam.dataset.uncertainty_samples import (
    BESIDE_M,
    EMPTY,
    GENERIC,
    MIN_CELLS,
    MIN_VISIBLE,
    ORDINARY,
    SEEDS_PER_BENCH,
    Benches,
    UncertaintySamples,
    _stimulus,
    check_uncertainty_data,
    make_samples,
    visible_objects,
)
from nlos_cam.errors import SceneError
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import WALL_GRID
from nlos_cam.reconstruct.wall_grid import NUMBERS_COLUMN, numbers_column, rig_numbers
from nlos_cam.render import Material, Scene, Sensor, SensorModel, render

RIG = load_rig("paper-rig")
SENSOR = SensorModel()
BENCHES = Benches(RIG, SENSOR)
BOX = object_box(RIG)
PLAIN = Stimulus(RIG, SENSOR)
SEEDS = range(6)
STILL = BenchSpread(*(0.0,) * len(SLIGHT))
"""No spread."""


def made(name: str, seed: int) -> Stimulus:
    kinds = {**TRAINING_OUTLIERS, **HELD_OUT_OUTLIERS}
    return draw_outlier(kinds[name], np.random.default_rng(seed), PLAIN)


every_outlier = pytest.mark.parametrize("name", [*TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS])


def touches_edge(stimulus: Stimulus) -> bool:
    seen = np.isfinite(stimulus.depth_m)
    return bool(seen[[0, -1]].any() or seen[:, [0, -1]].any())


@every_outlier
def test_outlier_repeats_by_seed(name: str) -> None:
    for seed in SEEDS:
        np.testing.assert_array_equal(made(name, seed).depth_m, made(name, seed).depth_m)


@every_outlier
def test_outlier_shows_surface_before_the_wall(name: str) -> None:
    for seed in SEEDS:
        stimulus = made(name, seed)
        surface_m = stimulus.depth_m[np.isfinite(stimulus.depth_m)]

        assert surface_m.size >= outliers.MIN_PIXELS
        assert surface_m.min() > 0.0
        assert stimulus.scene.rig == stimulus.rig


@every_outlier
@pytest.mark.parametrize("z_m", [(0.02, 0.3), (0.08, 0.36), (0.30, 0.37)])
def test_outlier_of_another_box_is_before_the_wall_too(name: str, z_m: tuple[float, float]) -> None:
    near_m, far_m = z_m
    box = BOX.model_copy(update={"z_near_m": near_m, "z_far_m": far_m})
    plain = Stimulus(RIG.model_copy(update={"object_box": box}), SENSOR)
    kind = {**TRAINING_OUTLIERS, **HELD_OUT_OUTLIERS}[name]

    for seed in SEEDS:
        depth_m = draw_outlier(kind, np.random.default_rng(seed), plain).depth_m
        assert np.nanmin(depth_m) > 0.0


def test_kinds_to_learn_and_to_judge_differ() -> None:
    assert not set(TRAINING_OUTLIERS) & set(HELD_OUT_OUTLIERS)
    assert {*TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS} > SHAPE_OUTLIERS


@pytest.mark.parametrize("kinds", [TRAINING_OUTLIERS, HELD_OUT_OUTLIERS])
def test_kinds_are_of_shape_and_of_other_measures(kinds: dict[str, object]) -> None:
    assert set(kinds) & SHAPE_OUTLIERS
    assert set(kinds) - SHAPE_OUTLIERS


def test_kinds_beside_weights_exclude_shapes_that_these_saw() -> None:
    without_shapes = {
        "small",
        "large",
        "far",
        "near",
        "half out",
        "dim",
        "other rig",
        "other sensor",
    }

    assert outliers.outliers_beside(0.0) == TRAINING_OUTLIERS
    assert set(outliers.outliers_beside(0.5)) == without_shapes


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


@pytest.mark.parametrize("name", OUTSIDE)
def test_outlier_lies_outside_by_its_own_measure(name: str) -> None:
    for seed in SEEDS:
        assert OUTSIDE[name](made(name, seed))


def test_ordinary_object_is_no_outlier() -> None:
    for seed in SEEDS:
        stimulus = ordinary(np.random.default_rng(seed), PLAIN)

        assert (stimulus.rig, stimulus.sensor) == (RIG, SENSOR)
        for name in ("far", "near", "dim", "glossy", "other rig", "other sensor"):
            assert not OUTSIDE[name](stimulus)


def test_outlier_without_surface_is_drawn_again() -> None:
    shy = Mock(side_effect=[PLAIN, PLAIN, ordinary(np.random.default_rng(0), PLAIN)])

    drawn = draw_outlier(shy, np.random.default_rng(0), PLAIN)

    assert np.isfinite(drawn.depth_m).any()
    assert shy.call_count == 3


@pytest.mark.parametrize("spread", [STILL, SLIGHT, WIDE])
def test_varied_rig_lies_within_its_spread(spread: BenchSpread) -> None:
    for seed in range(50):
        rig, sensor = vary_bench(RIG, SENSOR, spread, np.random.default_rng(seed))

        assert abs(rig.lidar.distance_m - RIG.lidar.distance_m) <= spread.place_m
        assert max(abs(rig.lidar.yaw_deg - 45.0), abs(rig.lidar.pitch_deg)) <= spread.angle_deg
        assert abs(np.log(sensor.bare_wall_counts / SENSOR.bare_wall_counts)) <= spread.gain + 1e-9
        assert sensor.ambient_counts <= spread.ambient_counts
        assert sensor.ripple_m <= spread.ripple_m


@pytest.mark.parametrize("seed", range(50))
def test_no_spread_keeps_the_rig(seed: int) -> None:
    assert vary_bench(RIG, SENSOR, STILL, np.random.default_rng(seed)) == (RIG, SENSOR)


def test_moved_rig_differs_in_lidar_pose_alone() -> None:
    other = move_lidar(RIG, 0.01, 2.0, -3.0)

    assert other.lidar.distance_m == pytest.approx(RIG.lidar.distance_m + 0.01)
    assert other.facing_deg == pytest.approx(47.0, abs=0.2)
    assert other.model_copy(update={"lidar": RIG.lidar}) == RIG


def test_empty_benches_are_plain_wide_or_without_occluder() -> None:
    benches = [vary_empty_bench(RIG, SENSOR, np.random.default_rng(seed)) for seed in range(200)]

    assert any(sensor == SENSOR for _, sensor in benches)
    assert any(abs(rig.lidar.distance_m - 0.2) > SLIGHT.place_m for rig, _ in benches)
    assert 5 < sum(rig.occluder is None for rig, _ in benches) < 50


@pytest.fixture(scope="module")
def two_of() -> Callable[[str], UncertaintySamples]:
    """Two samples of a kind."""
    return cache(lambda kind: make_samples(kind, range(2), BENCHES))


def test_sample_of_empty_bench_shows_nothing(two_of: Callable[[str], UncertaintySamples]) -> None:
    empty = two_of(EMPTY)

    assert not empty.image.any()
    assert not empty.cells.any()


@pytest.mark.parametrize("kind", [ORDINARY, "plates"])
def test_sample_shows_its_object(two_of: Callable[[str], UncertaintySamples], kind: str) -> None:
    shown = two_of(kind)
    apart_m = np.abs(shown.depth_m - two_of(EMPTY).depth_m[0])

    assert (shown.image > 0).any((1, 2)).all()
    assert (shown.cells > 50).all()
    assert ((apart_m > 0.02).sum((1, 2)) > 50).all()


def test_sample_depends_on_its_seed_alone(two_of: Callable[[str], UncertaintySamples]) -> None:
    alone = make_samples(ORDINARY, [1], BENCHES)

    np.testing.assert_array_equal(alone.depth_m[0], two_of(ORDINARY).depth_m[1])
    np.testing.assert_array_equal(alone.intensity[0], two_of(ORDINARY).intensity[1])


def _benches(kind: str) -> list[Rig]:
    """Return the rigs of a first bench's first and last seed, and of the next bench."""
    seeds = (0, SEEDS_PER_BENCH - 1, SEEDS_PER_BENCH)
    return [_stimulus(kind, seed, BENCHES).rig for seed in seeds]


def test_half_of_the_outlier_benches_lie_slightly_off() -> None:
    assert [rig == RIG for rig in _benches("plates")] == [True, True, False]


def test_ordinary_benches_lie_slightly_off() -> None:
    first, same, other = _benches(ORDINARY)

    assert RIG not in (first, same, other)
    assert first == same != other


@pytest.mark.parametrize("of", range(3))
def test_kinds_share_no_noise(of: int) -> None:
    kinds = [EMPTY, ORDINARY, *TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS]

    noise = {uncertainty_samples._generator(kind, 3, of).bytes(8) for kind in kinds}

    assert len(noise) == len(kinds)


def test_kinds_share_no_bench() -> None:
    """A shared bench would let a network tell outliers from ordinary objects."""
    kinds = ("plates", "blobs", ORDINARY)

    slight = [_stimulus(kind, SEEDS_PER_BENCH, BENCHES) for kind in kinds]

    assert len({stimulus.rig.checksum for stimulus in slight}) == 3
    assert len({stimulus.sensor.bare_wall_counts for stimulus in slight}) == 3


@pytest.mark.parametrize(("share", "kinds"), [(0.0, 17), (0.25, 8)])
def test_counts_follow_recipe_and_share_of_generic_shapes(share: float, kinds: int) -> None:
    recipe = small_recipe(task="doubt", outliers=20, empties=9)

    counts = uncertainty_samples.counts_of(recipe, share)

    assert counts[EMPTY] == 9
    assert sum(counts.values()) == 9 + kinds * 20 + kinds * 10
    assert counts.get(GENERIC, 0) == share * kinds * 10


def test_calibration_has_a_sample_of_every_kind() -> None:
    counts = {EMPTY: 3, "plates": 2, ORDINARY: 100, GENERIC: 0}

    held_out = uncertainty_samples.held_out_of(counts)

    assert held_out == {EMPTY: 1, "plates": 1, ORDINARY: 15, GENERIC: 0}


def test_generic_shape_repeats_by_seed_on_a_bench_slightly_off() -> None:
    one, same = (make_samples(GENERIC, [SEEDS_PER_BENCH], BENCHES) for _ in range(2))

    np.testing.assert_array_equal(one.depth_m, same.depth_m)
    assert _stimulus(GENERIC, 0, BENCHES).rig != RIG


@pytest.fixture
def pieces_made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Kind and first seed of each piece of samples made, in no time."""
    made = list[tuple[str, int]]()

    def quick(kind: str, seeds: range, *_: object) -> UncertaintySamples:
        made.append((kind, seeds.start))
        maps = np.zeros((len(seeds), 2, 2), np.float32)
        kinds = np.array([kind] * len(seeds))
        cells = np.array(seeds, np.int32)
        return UncertaintySamples(maps, maps, maps.astype(np.float16), cells, kinds)

    monkeypatch.setattr(uncertainty_samples, "make_samples", quick)
    return made


EMPTIES = {EMPTY: 150}
WITH_FAR = {EMPTY: 150, "far": 20}


def _on_disk(folder: Path, counts: dict[str, int], **options: Any) -> UncertaintySamples:
    return uncertainty_samples.samples_on_disk(folder, counts, 7, BENCHES, **options)


def test_samples_on_disk_makes_only_missing_samples(
    tmp_path: Path, pieces_made: list[tuple[str, int]]
) -> None:
    first = _on_disk(tmp_path, EMPTIES)

    assert pieces_made == [(EMPTY, 7), (EMPTY, 107)]

    both = _on_disk(tmp_path, WITH_FAR)

    assert pieces_made[2:] == [("far", 7)]
    np.testing.assert_array_equal(both.cells[:150], first.cells)


@pytest.mark.usefixtures("pieces_made")
def test_samples_on_disk_come_by_kind_and_seed(tmp_path: Path) -> None:
    samples = _on_disk(tmp_path, WITH_FAR)

    assert samples.kind.tolist() == [EMPTY] * 150 + ["far"] * 20
    assert samples.where(samples.kind == "far").cells.tolist() == list(range(7, 27))


@pytest.mark.usefixtures("pieces_made")
def test_samples_on_disk_report_progress(tmp_path: Path) -> None:
    progress = list[tuple[int, int]]()

    _on_disk(tmp_path, WITH_FAR, on_progress=lambda *at: progress.append(at))

    assert progress == [(100, 170), (150, 170), (170, 170)]


def test_samples_on_disk_makes_damaged_samples_again(
    tmp_path: Path, pieces_made: list[tuple[str, int]]
) -> None:
    _on_disk(tmp_path, WITH_FAR)
    damaged = next(tmp_path.glob("*-far-*.npz"))
    damaged.write_bytes(damaged.read_bytes()[:-40])
    pieces_made.clear()

    _on_disk(tmp_path, WITH_FAR)

    assert pieces_made == [("far", 7)]


def test_samples_of_many_rigs_hold_the_numbers_of_their_records() -> None:
    benches = Benches(RIG, SENSOR, rigs=RigRange(), maps_rig=WALL_GRID)
    samples = make_samples(EMPTY, range(2), benches)

    assert len(samples) == 2
    for seed in range(2):
        wanted = numbers_column(rig_numbers(benches.record(EMPTY, seed)))
        np.testing.assert_array_equal(samples.depth_m[seed, :, NUMBERS_COLUMN], wanted)


def test_each_sample_of_many_rigs_has_a_rig_of_its_own() -> None:
    benches = Benches(RIG, SENSOR, rigs=RigRange())
    rigs = [benches.record(kind, seed) for kind in (GENERIC, "far") for seed in range(20)]

    assert len({rig.checksum for rig in rigs}) == len(rigs)


BARE = Sensor(RIG, SensorModel()).maps(render(Scene(RIG)).multi, None)


def maps_with(changed: list[int], sensor: SensorModel = SENSOR) -> Any:
    """Maps of the empty bench, in which so many cells of each are farther, and their dataset."""
    depth_m = np.stack([BARE.depth_m] * len(changed))
    for one, count in zip(depth_m, changed, strict=True):
        one.flat[:count] += np.float32(2 * BESIDE_M)
    intensity = np.stack([BARE.intensity] * len(changed))
    maps = MapSet(depth_m, intensity, np.zeros((len(changed), 64, 64), np.float16))
    plan = SimpleNamespace(sensor=sensor)
    return maps, SimpleNamespace(plan=plan, benches=lambda: repeat(RIG))


def test_objects_that_change_hardly_a_cell_are_not_visible() -> None:
    changed = [0, MIN_CELLS - 1, *[MIN_CELLS] * MIN_VISIBLE]

    found = visible_objects(*maps_with(changed))

    assert found.tolist() == [False, False, *[True] * MIN_VISIBLE]


def test_a_textured_wall_hides_no_object() -> None:
    textured = SensorModel(wall_texture=0.05)

    assert visible_objects(*maps_with([MIN_CELLS] * MIN_VISIBLE, textured)).all()


def test_bench_that_hides_nearly_all_objects_leaves_none_out() -> None:
    assert visible_objects(*maps_with([0, 0, MIN_CELLS])).all()


@pytest.mark.parametrize(
    "other", [{"radiometry": "lambertian"}, {"material": Material(kind="retroreflective")}]
)
def test_data_of_another_light_than_the_samples_are_refused(other: dict[str, Any]) -> None:
    ours = SimpleNamespace(plan=DatasetPlan(RIG, 0))
    theirs = SimpleNamespace(plan=replace(ours.plan, **other))
    pipeline = SimpleNamespace(record=load_record(shipped_folder()))

    with pytest.raises(SceneError, match="radiometry or material"):
        check_uncertainty_data(small_recipe(), pipeline, ours, theirs)  # type: ignore[arg-type]


def test_data_off_their_record_are_refused() -> None:
    """Half of the outliers are on benches as recorded: they would be known by that."""
    ours = SimpleNamespace(plan=DatasetPlan(RIG, 0))
    theirs = SimpleNamespace(plan=replace(ours.plan, off_record=True))
    pipeline = SimpleNamespace(record=load_record(shipped_folder()))

    with pytest.raises(SceneError, match="without --off-record"):
        check_uncertainty_data(small_recipe(), pipeline, ours, theirs)  # type: ignore[arg-type]
