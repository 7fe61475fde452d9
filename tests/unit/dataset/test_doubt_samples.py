"""Samples for the doubt network: determined by their seeds, cached on disk, made only where they are missing."""

from pathlib import Path

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig
from small_run import small_recipe

from nlos_cam.dataset import (
    EMPTY,
    GENERIC,
    HELD_OUT_OUTLIERS,
    ORDINARY,
    TRAINING_OUTLIERS,
    doubt_samples,
    samples_on_disk,
)
from nlos_cam.dataset.doubt_samples import SEEDS_PER_BENCH, DoubtSamples, _generator, _stimulus, counts_of, make_samples
from nlos_cam.render import SensorModel

RIG, SENSOR = load_rig("paper-rig"), SensorModel()


@pytest.fixture(scope="module")
def some() -> dict[str, DoubtSamples]:
    return {kind: make_samples(kind, range(2), RIG, SENSOR) for kind in (EMPTY, ORDINARY, "plates")}


def test_empty_bench_has_no_image_and_no_cells(some: dict[str, DoubtSamples]) -> None:
    assert not some[EMPTY].image.any()
    assert not some[EMPTY].cells.any()


@pytest.mark.parametrize("kind", [ORDINARY, "plates"])
def test_hidden_object_shows_in_maps(some: dict[str, DoubtSamples], kind: str) -> None:
    assert (some[kind].image > 0).any((1, 2)).all()
    assert (some[kind].cells > 50).all()
    beyond = np.abs(some[kind].depth_m - some[EMPTY].depth_m[0]) > 0.02
    assert (beyond.sum((1, 2)) > 50).all()


def test_sample_depends_on_its_seed_alone(some: dict[str, DoubtSamples]) -> None:
    alone = make_samples(ORDINARY, [1], RIG, SENSOR)
    np.testing.assert_array_equal(alone.depth_m[0], some[ORDINARY].depth_m[1])
    np.testing.assert_array_equal(alone.intensity[0], some[ORDINARY].intensity[1])


def test_ordinary_and_half_of_outlier_benches_lie_slightly_off() -> None:
    seeds = 0, SEEDS_PER_BENCH - 1, SEEDS_PER_BENCH
    ordinary, plates = ([_stimulus(kind, seed, RIG, SENSOR).rig for seed in seeds] for kind in (ORDINARY, "plates"))
    assert [rig == RIG for rig in plates] == [True, True, False]
    assert RIG not in ordinary
    assert ordinary[0] == ordinary[1] != ordinary[2]


def test_usual_objects_are_as_many_as_outliers_with_generic_shapes_by_their_share() -> None:
    recipe = small_recipe(task="doubt", outliers=20, empties=9)
    for share, kinds in ((0.0, 17), (0.25, 8)):
        counts = counts_of(recipe, share)
        assert counts[EMPTY] == 9
        assert sum(counts.values()) == 9 + kinds * 20 + kinds * 10
        assert counts.get(GENERIC, 0) == share * kinds * 10
    one, same = (make_samples(GENERIC, [SEEDS_PER_BENCH], RIG, SENSOR) for _ in range(2))
    np.testing.assert_array_equal(one.depth_m, same.depth_m)
    assert _stimulus(GENERIC, 0, RIG, SENSOR).rig != RIG


def test_kinds_share_no_bench_and_no_noise() -> None:
    """A shared bench would let a network tell outliers from ordinary objects."""
    kinds = [EMPTY, ORDINARY, *TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS]
    for of in range(3):
        assert len({_generator(kind, 3, of).bytes(8) for kind in kinds}) == len(kinds)
    slight = [_stimulus(kind, SEEDS_PER_BENCH, RIG, SENSOR) for kind in ("plates", "blobs", ORDINARY)]
    assert len({stimulus.rig.checksum for stimulus in slight}) == 3
    assert len({stimulus.sensor.bare_wall_counts for stimulus in slight}) == 3


def test_samples_on_disk_makes_only_missing_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[tuple[str, int]]()

    def quick(kind: str, seeds: range, rig: Rig, sensor: SensorModel, accuracy: str) -> DoubtSamples:
        del rig, sensor, accuracy
        made.append((kind, seeds.start))
        maps, images = np.zeros((len(seeds), 2, 2), np.float32), np.zeros((len(seeds), 2, 2), np.float16)
        cells = np.array(seeds, np.int32)
        return DoubtSamples(maps, maps, images, cells, np.array([kind] * len(seeds)))

    monkeypatch.setattr(doubt_samples, "make_samples", quick)
    first = samples_on_disk(tmp_path, {EMPTY: 150}, 7, RIG, SENSOR)
    assert made == [(EMPTY, 7), (EMPTY, 107)]
    told, asked = list[tuple[int, int]](), {EMPTY: 150, "far": 20}
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
