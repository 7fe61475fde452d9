import tracemalloc

import numpy as np
import pytest

from nlos_cam.frames import LidarMaps, MapMean


def noise(number: int, valid_share: float = 0.8) -> LidarMaps:
    """As of a device: depth in quarters of a millimetre, and no return here and there."""
    generator = np.random.default_rng(number)
    depth_m = (0.00025 * generator.integers(1, 40_000, (64, 80))).astype(np.float32)
    depth_m[generator.random((64, 80)) > valid_share] = np.nan
    valid = ~np.isnan(depth_m)
    return LidarMaps(depth_m, np.where(valid, generator.uniform(1, 255, (64, 80)), 0.0).astype(np.float32), valid)


def mean_of(maps: list[LidarMaps]) -> LidarMaps:
    """The definition."""
    valid = np.stack([each.valid for each in maps])
    count, seen = valid.sum(axis=0), valid.any(axis=0)
    depth_m = np.stack([each.depth_m for each in maps]).astype(np.float64).sum(axis=0, where=valid)
    intensity = np.stack([each.intensity for each in maps]).astype(np.float64).sum(axis=0, where=valid)
    depth_m, intensity = (np.where(seen, total / np.maximum(count, 1), np.nan) for total in (depth_m, intensity))
    return LidarMaps(depth_m.astype(np.float32), np.nan_to_num(intensity).astype(np.float32), seen)


def assert_equal(one: LidarMaps, other: LidarMaps) -> None:
    np.testing.assert_array_equal(one.depth_m, other.depth_m)
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.valid, other.valid)
    assert one.depth_m.dtype == one.intensity.dtype == np.float32


@pytest.mark.parametrize("frames", [1, 2, 5])
@pytest.mark.parametrize("valid_share", [1.0, 0.5, 0.05])
def test_it_is_the_mean_of_the_last_maps_over_those_that_were_valid(frames: int, valid_share: float) -> None:
    mean, given = MapMean(frames), [noise(number, valid_share) for number in range(12)]
    for number, maps in enumerate(given):
        assert_equal(mean.add(maps), mean_of(given[max(0, number + 1 - frames) : number + 1]))


def test_no_error_accumulates() -> None:
    mean, given = MapMean(7), [noise(number) for number in range(50)]
    for turn in range(4000):
        found = mean.add(given[turn % 50])
    assert_equal(found, mean_of([given[turn % 50] for turn in range(3993, 4000)]))


def test_one_frame_is_itself() -> None:
    maps = noise(0)
    assert MapMean(1).add(maps) is maps


def test_noise_falls_with_the_root_of_the_number_averaged() -> None:
    mean, wall = MapMean(100), np.full((64, 80), 0.3)
    for number in range(100):
        depth_m = (wall + np.random.default_rng(number).normal(0.0, 1e-3, wall.shape)).astype(np.float32)
        found = mean.add(LidarMaps(depth_m, np.full(wall.shape, 40, np.float32), wall > 0))
    assert np.std(found.depth_m) == pytest.approx(1e-4, rel=0.05)


def test_a_step_is_forgotten_after_as_many_frames() -> None:
    before, after = noise(1), noise(2)
    mean = MapMean(3)
    for maps in (before, before, before, after, after):
        assert not np.array_equal(mean.add(maps).depth_m, after.depth_m, equal_nan=True)
    np.testing.assert_allclose(mean.add(after).depth_m, after.depth_m, rtol=1e-6)


def test_what_is_given_is_neither_changed_nor_kept() -> None:
    mean, maps, again = MapMean(2), noise(3), noise(3)
    first = mean.add(maps)
    kept = first.depth_m.copy()
    maps.depth_m[:] = 9.0
    mean.add(noise(4))
    np.testing.assert_array_equal(first.depth_m, kept)
    assert_equal(mean.add(noise(5)), mean_of([noise(4), noise(5)]))
    np.testing.assert_array_equal(kept, again.depth_m)


def test_memory_does_not_grow_with_the_run() -> None:
    mean, maps = MapMean(10), noise(0)
    for _ in range(20):
        mean.add(maps)
    tracemalloc.start()
    for _ in range(200):
        mean.add(maps)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 100_000
