"""Arrays to shuffled batches. Where the arrays come from is not this package's business.

Where a compressor's training maps come from: arrays in memory, or whatever else gives batches of them.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlos_models.arrays import Float16, Float32


@dataclass(frozen=True)
class MapSet:
    """Lidar maps and the images of what was hidden: what the compressor learns from."""

    depth_m: Float32
    """(n, 64, 80); NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80), or in colour (n, 3, 64, 80)."""
    image: Float16 | Float32
    """(n, 64, 64) in [0, 1], or in colour (n, 3, 64, 64)."""


def shuffled(count: int, batch: int, generator: torch.Generator) -> Iterator[Tensor]:
    """Index batches over one epoch; the last, smaller one is left out, so that no batch norm sees a single sample."""
    order = torch.randperm(count, generator=generator)
    for start in range(0, count - min(batch, count) + 1, batch):
        yield order[start : start + batch]


def flip_some(tensors: list[Tensor], flips: Tensor) -> list[Tensor]:
    """Mirror the flagged samples (n,) top to bottom in every tensor (n, ..., rows, columns).

    The rig is symmetric about y = 0: a mirrored object is seen as mirrored maps, so this is data, not distortion.
    """
    chosen = flips.bool()
    return [torch.where(chosen.view(-1, *[1] * (t.ndim - 1)), t.flip(-2), t) for t in tensors]


def as_images(images: Float16 | Float32) -> Tensor:
    """Images (n, 64, 64) as the (n, 1, 64, 64) of float32 that networks take; those in colour have their channels."""
    tensor = torch.from_numpy(images.astype(np.float32))
    return tensor[:, None] if tensor.ndim == 3 else tensor


def image_batches(images: Float16, batch: int, generator: torch.Generator) -> Iterator[Tensor]:
    """One epoch of images (b, 1 or 3, 64, 64), shuffled and mirrored at random."""
    for index in shuffled(len(images), batch, generator):
        chosen = as_images(images[index.numpy()])
        yield flip_some([chosen], torch.rand(len(index), generator=generator) < 0.5)[0]


class MapBatch(NamedTuple):
    """One batch of maps, some of them mirrored."""

    depth_m: Tensor
    """(b, 64, 80)."""
    intensity: Tensor
    """(b, 64, 80), or in colour (b, 3, 64, 80)."""
    image: Tensor
    """(b, 1, 64, 64), or in colour (b, 3, 64, 64)."""
    row: Tensor
    """(b,); which samples of the set these are."""
    mirrored: Tensor
    """(b,); which of them are mirrored."""


def as_batch(maps: MapSet, row: NDArray[np.int64], mirrored: NDArray[np.bool_]) -> MapBatch:
    """Samples (b,) of a set, those that are flagged mirrored."""
    depth, intensity = torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)
    image, flips = as_images(maps.image), torch.from_numpy(mirrored)
    depth, intensity, image = flip_some([depth, intensity, image], flips)
    return MapBatch(depth, intensity, image, torch.from_numpy(row), flips)


def map_batches(maps: MapSet, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
    """One epoch of maps and images, shuffled and mirrored at random."""
    for index in shuffled(len(maps.image), batch, generator):
        row = index.numpy()
        chosen = MapSet(maps.depth_m[row], maps.intensity[row], maps.image[row])
        yield as_batch(chosen, row, (torch.rand(len(row), generator=generator) < 0.5).numpy())


STATISTICS_OBJECTS = 10_000
"""So many objects tell the channels' mean and spread to far better than the noise that training adds."""


class MapSource(Protocol):
    """Training maps that need not fit into memory; it must be picklable to be shared by several processes."""

    @property
    def image(self) -> Float16 | Float32:
        """All images (n, 64, 64) in [0, 1], in the order of the rows: 8 kB an object."""
        ...

    def first(self, count: int) -> MapSet:
        """The first `count` objects, or all, in memory."""
        ...

    def batches(self, batch: int, generator: torch.Generator) -> Iterable[MapBatch]:
        """One epoch, shuffled and mirrored at random by the generator alone: the same generator, the same epoch."""
        ...


@dataclass(frozen=True)
class InMemory:
    """A map set as a source."""

    maps: MapSet

    @property
    def image(self) -> Float16 | Float32:
        """All images (n, 64, 64)."""
        return self.maps.image

    def first(self, count: int) -> MapSet:
        """The first `count` objects."""
        return first_of(self.maps, count)

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
        """One epoch."""
        return map_batches(self.maps, batch, generator)


def first_of(maps: MapSet, count: int) -> MapSet:
    """The first `count` objects of a map set, or all if there are not so many."""
    return replace(maps, depth_m=maps.depth_m[:count], intensity=maps.intensity[:count], image=maps.image[:count])


def less_bare_wall(maps: MapSet, depth_m: Float32, intensity: Float32) -> MapSet:
    """Difference maps: maps less the bare wall's (64, 80); a cell without a return in either has none."""
    difference_m = maps.depth_m - depth_m
    seen = ~np.isnan(difference_m)
    return replace(maps, depth_m=difference_m, intensity=np.where(seen, maps.intensity - intensity, np.float32(0.0)))
