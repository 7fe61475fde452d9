"""Sources of maps: the first of a set, its batches, and difference maps."""

import numpy as np
import torch
from nlos_models.data import InMemory, first_of, less_bare_wall, map_batches
from small_maps import small_maps


def test_the_first_of_a_set_are_its_first_and_never_more_than_all() -> None:
    maps = small_maps(5, 0)
    few = first_of(maps, 2)
    for name in ("depth_m", "intensity", "image"):
        np.testing.assert_array_equal(getattr(few, name), getattr(maps, name)[:2])
    assert len(InMemory(maps).first(9).image) == 5


def test_a_set_in_memory_gives_the_batches_of_its_arrays() -> None:
    maps = small_maps(6, 0)
    mine, its = (
        list(make(3, torch.Generator().manual_seed(1)))
        for make in (InMemory(maps).batches, lambda *how: map_batches(maps, *how))
    )
    assert len(mine) == 2
    for one, other in zip(mine, its, strict=True):
        assert torch.equal(one.row, other.row)
        assert torch.equal(one.image, other.image)


def test_difference_maps_are_the_maps_less_the_bare_wall_where_both_have_a_return() -> None:
    maps = small_maps(3, 0)
    depth, intensity = np.full((64, 80), 0.125, np.float32), np.full((64, 80), 4.0, np.float32)
    depth[30] = np.nan
    difference = less_bare_wall(maps, depth, intensity)
    seen = ~np.isnan(maps.depth_m) & ~np.isnan(depth)
    assert 0 < seen.sum() < (~np.isnan(maps.depth_m)).sum()
    np.testing.assert_array_equal(~np.isnan(difference.depth_m), seen)
    np.testing.assert_allclose(difference.depth_m[seen], maps.depth_m[seen] - 0.125)
    np.testing.assert_allclose(difference.intensity[seen], maps.intensity[seen] - 4.0)
    assert not difference.intensity[~seen].any()
    assert difference.image is maps.image
