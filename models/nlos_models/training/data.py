"""Map sets, the sources that they come from, and shuffled, mirrored batches of them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlos_models.arrays import Float16, Float32

STATISTICS_OBJECTS = 10_000
"""Objects for the channels' mean and spread; their sampling error is far below the noise that
training adds.
"""
ROUNDING_VARIANCE = 1 / 12
"""Of a pixel's whole counts, in counts squared."""
SMALLEST_COUNTS = 0.5
"""Divisor of the noise's share where the sensor counted less."""


@dataclass(frozen=True)
class MapSet:
    """Lidar maps with the images of the hidden objects: a compressor's training samples, in
    memory.
    """

    depth_m: Float32
    """(n, 64, 80); NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80), or in color (n, 3, 64, 80)."""
    image: Float16 | Float32
    """(n, 64, 64) in [0, 1], or in color (n, 3, 64, 64)."""


def shuffled(count: int, batch: int, generator: torch.Generator) -> Iterator[Tensor]:
    """Yield the index batches of one epoch, without the last, smaller one: a batch norm needs
    several samples.
    """
    # A new order each epoch, by the caller's generator, and without a remainder: of a batch of
    # one, a batch norm has no variance.
    order = torch.randperm(count, generator=generator)
    for start in range(0, count - min(batch, count) + 1, batch):
        yield order[start : start + batch]


def flip_some(tensors: list[Tensor], flips: Tensor) -> list[Tensor]:
    """Mirror the flagged samples (n,) top to bottom in every tensor (n, ..., rows, columns).

    The rig is symmetric about y = 0: the maps of a mirrored object are the object's maps, mirrored.
    So these are samples that could have been rendered.
    """
    # Flags broadcast over (n, 1, 1, ...); both orientations are computed and one is taken, which
    # is faster than indexing single samples.
    chosen = flips.bool()
    return [torch.where(chosen.view(-1, *[1] * (t.ndim - 1)), t.flip(-2), t) for t in tensors]


def as_images(images: Float16 | Float32) -> Tensor:
    """Return images (n, 64, 64) as float32 (n, 1, 64, 64) for networks; color images have their
    channels already.
    """
    tensor = torch.from_numpy(images.astype(np.float32))
    return tensor[:, None] if tensor.ndim == 3 else tensor


def image_batches(images: Float16, batch: int, generator: torch.Generator) -> Iterator[Tensor]:
    """Yield one epoch of images (b, 1 or 3, 64, 64), shuffled and mirrored at random."""
    for index in shuffled(len(images), batch, generator):
        chosen = as_images(images[index.numpy()])
        yield flip_some([chosen], torch.rand(len(index), generator=generator) < 0.5)[0]


@dataclass(frozen=True)
class MapNoise:
    """Noise of a map cell's intensity, the mean over the cell's pixels, each of whole counts."""

    read_variance: float
    """Of a pixel, in counts squared."""
    shot_variance: float
    """Of a pixel, per count of light."""
    ambient_counts: float
    pixels: float
    """Of a cell."""

    def deviation(self, counts: Tensor) -> Tensor:
        """Return the standard deviation of intensities, in counts."""
        # Read noise is the same at any light, shot noise (Poisson) grows with it; rounding to
        # whole counts is uniform within a count, with variance 1 / 12. The mean over k pixels has
        # 1 / k of their sum.
        light = self.shot_variance * (counts + self.ambient_counts)
        return ((self.read_variance + light + ROUNDING_VARIANCE) / self.pixels).sqrt()

    def add(
        self,
        counts: Tensor,
        generator: torch.Generator | None = None,
        *,
        behind: Tensor | None = None,
    ) -> Tensor:
        """Return intensities with noise drawn for each, in counts, none below 0.

        Of intensities that are scaled, `behind` are those that the sensor counted, (n, 64, 80).
        """
        deviates = torch.randn(
            counts.shape, generator=generator, device=counts.device, dtype=counts.dtype
        )
        # Normal, since a cell's mean over tens of pixels is nearly so; a count is not negative.
        if behind is None:
            return (counts + self.deviation(counts) * deviates).clamp(min=0)
        # Alignment scales the light of a cell, and with it the noise: its share of the light stays
        # what it was when the sensor counted it.
        share = self.deviation(behind) / behind.clamp(min=SMALLEST_COUNTS)
        return (counts + counts * share[:, None] * deviates).clamp(min=0)

    def draw(self, depth_m: Tensor, intensity: Tensor, generator: torch.Generator) -> Tensor:
        """Return the intensities of expected maps with noise drawn; a cell without a return keeps
        its own.
        """
        drawn = self.add(intensity, generator)
        # In color three intensities share one depth: (n, 64, 80) against (n, 3, 64, 80).
        nowhere = depth_m.isnan()
        return torch.where(nowhere[:, None] if drawn.dim() == 4 else nowhere, intensity, drawn)

    def expose(self, maps: "MapSet", seed: int) -> "MapSet":
        """Return expected maps as one exposure gives them."""
        depth_m = torch.from_numpy(maps.depth_m)
        intensity = torch.from_numpy(maps.intensity)
        return replace(
            maps,
            intensity=self.draw(depth_m, intensity, torch.Generator().manual_seed(seed)).numpy(),
        )


class MapBatch(NamedTuple):
    """Batch of maps, some of them mirrored."""

    depth_m: Tensor
    """(b, 64, 80)."""
    intensity: Tensor
    """(b, 64, 80), or in color (b, 3, 64, 80)."""
    image: Tensor
    """(b, 1, 64, 64), or in color (b, 3, 64, 64)."""
    row: Tensor
    """(b,): indices of the samples in their set."""
    mirrored: Tensor
    """(b,): true where the sample is mirrored."""


def as_batch(maps: MapSet, row: NDArray[np.int64], mirrored: NDArray[np.bool_]) -> MapBatch:
    """Return samples (b,) as a batch, the flagged ones mirrored; `row` are their indices in the
    whole set.
    """
    depth = torch.from_numpy(maps.depth_m)
    intensity = torch.from_numpy(maps.intensity)
    image = as_images(maps.image)
    flips = torch.from_numpy(mirrored)
    depth, intensity, image = flip_some([depth, intensity, image], flips)
    return MapBatch(depth, intensity, image, torch.from_numpy(row), flips)


def map_batches(maps: MapSet, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
    """Yield one epoch of maps and images, shuffled and mirrored at random."""
    for index in shuffled(len(maps.image), batch, generator):
        row = index.numpy()
        chosen = MapSet(maps.depth_m[row], maps.intensity[row], maps.image[row])
        yield as_batch(chosen, row, (torch.rand(len(row), generator=generator) < 0.5).numpy())


class MapSource(Protocol):
    """Training maps that need not fit into memory; several processes need it to be picklable."""

    @property
    def image(self) -> Float16 | Float32:
        """All images (n, 64, 64) in [0, 1], in the order of the rows: 8 kB per object."""
        ...

    def first(self, count: int) -> MapSet:
        """Return the first `count` objects, or all, in memory."""
        ...

    def batches(self, batch: int, generator: torch.Generator) -> Iterable[MapBatch]:
        """Return one epoch, shuffled and mirrored by the generator alone: the same generator, the
        same epoch.
        """
        ...


@dataclass(frozen=True)
class InMemory:
    """Map source of a map set."""

    maps: MapSet

    @property
    def image(self) -> Float16 | Float32:
        return self.maps.image

    def first(self, count: int) -> MapSet:
        return first_of(self.maps, count)

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
        return map_batches(self.maps, batch, generator)


@dataclass(frozen=True)
class WithNoise:
    """Map source of expected maps, to whose batches the sensor's noise is added, in each epoch
    another draw.
    """

    source: MapSource
    noise: MapNoise

    @property
    def image(self) -> Float16 | Float32:
        return self.source.image

    def first(self, count: int) -> MapSet:
        """Return the first `count` objects, without noise."""
        return self.source.first(count)

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[MapBatch]:
        """Yield one epoch; a cell without a return keeps its intensity."""
        # Expected maps are rendered once; another draw of the sensor's noise in every epoch costs
        # nothing and cannot be learnt by heart.
        for plain in self.source.batches(batch, generator):
            yield plain._replace(
                intensity=self.noise.draw(plain.depth_m, plain.intensity, generator)
            )


def first_of(maps: MapSet, count: int) -> MapSet:
    """Return the first `count` objects of a map set, or all if there are fewer."""
    return replace(
        maps,
        depth_m=maps.depth_m[:count],
        intensity=maps.intensity[:count],
        image=maps.image[:count],
    )


def subtract_bare_wall(maps: MapSet, depth_m: Float32, intensity: Float32) -> MapSet:
    """Return difference maps: maps minus the bare wall's (64, 80); a cell has a return where both
    have one.
    """
    # NaN in either is NaN in the difference: no return, no difference.
    difference_m = maps.depth_m - depth_m
    valid = ~np.isnan(difference_m)
    return replace(
        maps,
        depth_m=difference_m,
        intensity=np.where(valid, maps.intensity - intensity, np.float32(0.0)),
    )
