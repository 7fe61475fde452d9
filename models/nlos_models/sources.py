"""Where a compressor's training maps come from: arrays in memory, or whatever else gives batches of them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from nlos_models.arrays import Float16, Float32
from nlos_models.data import MapBatch, MapSet, map_batches

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
