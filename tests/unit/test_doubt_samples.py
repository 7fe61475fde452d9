"""Samples: the same bits for the same seeds, kept on disk, and made only where they are missing."""

from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import Rig, load_rig

from nlos_cam.dataset import doubt_samples
from nlos_cam.dataset.doubt_samples import BENCH, EMPTY, ORDINARY, DoubtSamples, make_samples, samples_on_disk
from nlos_cam.dataset.outliers import TO_JUDGE, TO_LEARN
from nlos_cam.render.sensor.model import SensorModel

RIG, SENSOR = load_rig("paper-rig"), SensorModel()


@pytest.fixture(scope="module")
def some() -> dict[str, DoubtSamples]:
    return {kind: make_samples(kind, range(2), RIG, SENSOR) for kind in (EMPTY, ORDINARY, "plates")}


def test_an_empty_bench_hides_nothing_and_shows_in_no_cell(some: dict[str, DoubtSamples]) -> None:
    assert not some[EMPTY].image.any()
    assert not some[EMPTY].cells.any()


@pytest.mark.parametrize("kind", [ORDINARY, "plates"])
def test_what_is_hidden_shows_in_the_maps(some: dict[str, DoubtSamples], kind: str) -> None:
    assert (some[kind].image > 0).any((1, 2)).all()
    assert (some[kind].cells > 50).all()
    beyond = np.abs(some[kind].depth_m - some[EMPTY].depth_m[0]) > 0.02
    assert (beyond.sum((1, 2)) > 50).all()


def test_the_same_seed_is_the_same_sample_in_whatever_company(some: dict[str, DoubtSamples]) -> None:
    alone = make_samples(ORDINARY, [1], RIG, SENSOR)
    np.testing.assert_array_equal(alone.depth_m[0], some[ORDINARY].depth_m[1])
    np.testing.assert_array_equal(alone.intensity[0], some[ORDINARY].intensity[1])


def test_ordinary_objects_and_every_second_bench_of_outliers_lie_slightly_off() -> None:
    seeds = 0, BENCH - 1, BENCH
    rigs = {
        kind: [doubt_samples._sight(kind, seed, RIG, SENSOR).rig for seed in seeds] for kind in (ORDINARY, "plates")
    }
    assert [rig == RIG for rig in rigs["plates"]] == [True, True, False]
    assert RIG not in rigs[ORDINARY]
    assert rigs[ORDINARY][0] == rigs[ORDINARY][1] != rigs[ORDINARY][2]


def test_no_two_kinds_share_a_bench_or_noise_which_would_tell_outliers_from_ordinary_objects() -> None:
    kinds = [EMPTY, ORDINARY, *TO_LEARN, *TO_JUDGE]
    for of in range(3):
        assert len({doubt_samples._generator(kind, 3, of).bytes(8) for kind in kinds}) == len(kinds)
    slight = [doubt_samples._sight(kind, BENCH, RIG, SENSOR) for kind in ("plates", "blobs", ORDINARY)]
    assert len({sight.rig.checksum for sight in slight}) == 3
    assert len({sight.sensor.bare_wall_counts for sight in slight}) == 3


def test_what_is_on_disk_is_read_and_only_what_is_missing_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    told = list[tuple[int, int]]()
    both = samples_on_disk(
        tmp_path, {EMPTY: 150, "far": 20}, 7, RIG, SENSOR, on_progress=lambda done, of: told.append((done, of))
    )
    assert made[2:] == [("far", 7)]
    np.testing.assert_array_equal(both.cells[:150], first.cells)
    assert both.kind.tolist() == [EMPTY] * 150 + ["far"] * 20
    assert told == [(100, 170), (150, 170), (170, 170)]
    assert both.where(both.kind == "far").cells.tolist() == list(range(7, 27))
