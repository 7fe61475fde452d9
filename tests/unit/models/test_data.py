"""Batches of maps and images, sources of maps, and difference maps."""

import numpy as np
import pytest
import torch
from nlos_models.data import InMemory, first_of, flip_some, image_batches, map_batches, shuffled, subtract_bare_wall
from small_maps import small_maps


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("count", "batch"), [(10, 5), (11, 5), (14, 5), (5, 5), (3, 5), (2, 2)])
def test_shuffled_batches_are_whole_and_repeat_no_sample(count: int, batch: int) -> None:
    batches = list(shuffled(count, batch, _generator()))
    assert {len(b) for b in batches} == {min(batch, count)}
    assert len(batches) == max(count // batch, 1)
    drawn = torch.cat(batches).tolist()
    assert len(set(drawn)) == len(drawn)
    assert set(drawn) <= set(range(count))
    first, again, other = (torch.cat(list(shuffled(50, 10, _generator(s)))) for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_flip_some_mirrors_flagged_samples_and_undoes_itself() -> None:
    maps, images = torch.rand(3, 64, 80), torch.rand(3, 1, 64, 64)
    flips = torch.tensor([True, False, True])
    mirrored_maps, mirrored_images = flip_some([maps, images], flips)
    assert torch.equal(mirrored_maps[1], maps[1])
    assert torch.equal(mirrored_maps[0], maps[0].flip(0))
    assert torch.equal(mirrored_images[2, 0], images[2, 0].flip(0))
    twice = flip_some([mirrored_maps, mirrored_images], flips)
    assert torch.equal(twice[0], maps)
    assert torch.equal(twice[1], images)


def test_image_batches_are_images_or_their_mirrors() -> None:
    images = np.random.default_rng(0).random((6, 64, 64)).astype(np.float16)
    known = {view.tobytes(): k for k, image in enumerate(images) for view in (image, image[::-1])}
    batches = list(image_batches(images, 3, _generator()))
    assert all(b.shape == (3, 1, 64, 64) and b.dtype == torch.float32 for b in batches)
    found = [known[image[0].numpy().astype(np.float16).tobytes()] for b in batches for image in b]
    assert sorted(found) == list(range(6))


def test_map_batches_mirror_maps_with_their_images() -> None:
    maps = small_maps(8, 0)
    batches = list(map_batches(maps, 4, _generator()))
    for batch in batches:
        parts = [torch.from_numpy(part)[batch.row] for part in (maps.depth_m, maps.intensity, maps.image[:, None])]
        depth_m, intensity, image = flip_some(parts, batch.mirrored)
        found, wanted = [batch.depth_m, batch.intensity, batch.image], [depth_m, intensity, image.float()]
        torch.testing.assert_close(found, wanted, rtol=0, atol=0, equal_nan=True)
    assert sorted(torch.cat([batch.row for batch in batches]).tolist()) == list(range(8))
    assert 0 < torch.cat([batch.mirrored for batch in batches]).sum() < 8


def test_first_of_returns_first_maps_and_at_most_all() -> None:
    maps = small_maps(5, 0)
    few = first_of(maps, 2)
    for name in ("depth_m", "intensity", "image"):
        np.testing.assert_array_equal(getattr(few, name), getattr(maps, name)[:2])
    assert len(InMemory(maps).first(9).image) == 5


def test_difference_maps_subtract_bare_wall_where_both_return() -> None:
    maps = small_maps(3, 0)
    depth, intensity = np.full((64, 80), 0.125, np.float32), np.full((64, 80), 4.0, np.float32)
    depth[30] = np.nan
    difference = subtract_bare_wall(maps, depth, intensity)
    valid = ~np.isnan(maps.depth_m) & ~np.isnan(depth)
    assert 0 < valid.sum() < (~np.isnan(maps.depth_m)).sum()
    np.testing.assert_array_equal(~np.isnan(difference.depth_m), valid)
    np.testing.assert_allclose(difference.depth_m[valid], maps.depth_m[valid] - 0.125)
    np.testing.assert_allclose(difference.intensity[valid], maps.intensity[valid] - 4.0)
    assert not difference.intensity[~valid].any()
    assert difference.image is maps.image
