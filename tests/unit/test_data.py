"""Arrays to batches: every sample once, no lone sample, mirrors that keep maps and images together."""

import numpy as np
import pytest
import torch
from nlos_models.data import MapSet, flip_some, image_batches, map_batches, shuffled


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("count", "batch"), [(10, 5), (11, 5), (14, 5), (5, 5), (3, 5), (2, 2)])
def test_batches_are_whole_and_repeat_no_sample(count: int, batch: int) -> None:
    batches = list(shuffled(count, batch, _generator()))
    assert {len(b) for b in batches} == {min(batch, count)}
    assert len(batches) == max(count // batch, 1)
    seen = torch.cat(batches).tolist()
    assert len(set(seen)) == len(seen)
    assert set(seen) <= set(range(count))


def test_the_generator_decides_the_order() -> None:
    first, again, other = (torch.cat(list(shuffled(50, 10, _generator(s)))) for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_only_flagged_samples_are_mirrored_and_twice_is_not_at_all() -> None:
    maps, images = torch.rand(3, 64, 80), torch.rand(3, 1, 64, 64)
    flips = torch.tensor([True, False, True])
    mirrored_maps, mirrored_images = flip_some([maps, images], flips)
    assert torch.equal(mirrored_maps[1], maps[1])
    assert torch.equal(mirrored_maps[0], maps[0].flip(0))
    assert torch.equal(mirrored_images[2, 0], images[2, 0].flip(0))
    twice = flip_some([mirrored_maps, mirrored_images], flips)
    assert torch.equal(twice[0], maps)
    assert torch.equal(twice[1], images)


def test_image_batches_are_the_images_or_their_mirrors() -> None:
    images = np.random.default_rng(0).random((6, 64, 64)).astype(np.float16)
    known = {image.tobytes(): k for k, image in enumerate(images)}
    known |= {image[::-1].tobytes(): k for k, image in enumerate(images)}
    batches = list(image_batches(images, 3, _generator()))
    assert all(b.shape == (3, 1, 64, 64) and b.dtype == torch.float32 for b in batches)
    found = [known[image[0].numpy().astype(np.float16).tobytes()] for b in batches for image in b]
    assert sorted(found) == list(range(6))


def test_maps_stay_with_their_image_and_are_mirrored_with_it() -> None:
    image = np.zeros((8, 64, 64), np.float16)
    depth, intensity = np.zeros((8, 64, 80), np.float32), np.zeros((8, 64, 80), np.float32)
    for k in range(8):
        image[k, 0], depth[k, 0], intensity[k, 0] = k + 1, k + 1, k + 1
    batches = list(map_batches(MapSet(depth, intensity, image), 4, _generator()))
    for batch in batches:
        for k, (number, mirrored) in enumerate(zip(batch.row.tolist(), batch.mirrored.tolist(), strict=True)):
            bright = 63 if mirrored else 0
            for part in (batch.depth_m[k], batch.intensity[k], batch.image[k, 0]):
                assert (part[bright] == number + 1).all()
                assert int((part > 0).any(1).sum()) == 1
    assert sorted(torch.cat([batch.row for batch in batches]).tolist()) == list(range(8))
    assert 0 < torch.cat([batch.mirrored for batch in batches]).sum() < 8
