"""Reader of datasets: whole, or streamed in shuffled batches where they are larger than memory."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Int64
from nlos_models import SIMULATION_ONLY
from nlos_models.training import MapBatch, MapSet, as_batch
from numpy.typing import NDArray

from nlos_cam.dataset.locked import LOCKED
from nlos_cam.dataset.plan import RECORDED, DatasetPlan
from nlos_cam.dataset.shards import Shard, array_names, read_arrays, shards_of
from nlos_cam.errors import RecordingError, SceneError

MAP_CHANNELS = ("depth_m", "intensity", "image")
RECORDED_CHANNELS = ("recorded_depth_m", "recorded_intensity", "image")
"""Maps of labelled recordings as the lidar measured them; the others are corrected by the bench."""
BUFFER = 40
"""Shards that are shuffled together and kept in memory (twice as many while a batch spans two such
blocks).
"""


@dataclass(frozen=True)
class Dataset:
    """Dataset in a folder: the heads of its shards, in the order of their seeds. Arrays are read
    when requested.
    """

    folder: Path
    plan: DatasetPlan
    shards: tuple[Shard, ...]
    channels: tuple[str, ...] = MAP_CHANNELS
    """Arrays of the maps and images."""

    def __len__(self) -> int:
        return sum(len(shard.seeds) for shard in self.shards)

    @property
    def seeds(self) -> set[int]:
        """Seeds of all objects."""
        return {seed for shard in self.shards for seed in shard.seeds}

    def column(self, name: str) -> NDArray[Any]:
        """Return an array over all samples: seed, category (n,), scene (n, 6), object_depth_m (n,
        64, 64) or a map.
        """
        return np.concatenate([read_arrays(shard, [name])[0] for shard in self.shards])

    def benches(self) -> Iterator[Rig]:
        """Yield each sample's rig as it is known, in their order."""
        return (self.plan.known_rig(seed) for shard in self.shards for seed in shard.seeds)

    def up_to(self, count: int) -> "Dataset":
        """Return the dataset of the first `count` objects, or itself if there are no more."""
        shards: list[Shard] = []
        left = count
        for shard in self.shards:
            if left > 0:
                shards.append(replace(shard, seeds=shard.seeds[:left]))
            left -= len(shard.seeds)
        return replace(self, shards=tuple(shards))

    def as_recorded(self) -> "Dataset":
        """Return the dataset with maps as the lidar measured them, from which a measured bare wall
        is subtracted; itself where it has no others.
        """
        if not array_names(self.shards[0]).issuperset(RECORDED_CHANNELS):
            return self
        return replace(self, channels=RECORDED_CHANNELS)

    def arrays(self) -> MapSet:
        """Read all maps and images."""
        return self.first(len(self))

    def first(self, count: int) -> MapSet:
        """Read the maps and images of the first `count` objects, or of all if there are fewer, and
        no shard beyond them.
        """
        parts = [*self.up_to(count).chunks()]
        names = (one.name for one in fields(MapSet))
        return MapSet(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def chunks(self) -> Iterator[MapSet]:
        """Yield all maps and images in order, one shard at a time."""
        for shard in self.shards:
            yield MapSet(*self.read(shard))

    def read(self, shard: Shard) -> list[NDArray[Any]]:
        """Read a shard's maps and images."""
        return read_arrays(shard, self.channels)

    def batches(self, seed: int, epoch: int, batch: int) -> Iterator[MapBatch]:
        """Yield one epoch of batches, shuffled and mirrored at random, by seed and epoch alone;
        `row` is the dataset's. The last, smaller batch is left out.
        """
        generator = np.random.default_rng([seed, epoch])
        blocks = self._shuffled_blocks(generator)
        order = np.concatenate([rows for _, rows in blocks])
        mirrored = generator.random(len(order)) < 0.5
        window = _Window(self, [shards for shards, _ in blocks])
        for start in range(0, len(order) - min(batch, len(order)) + 1, batch):
            rows = order[start : start + batch]
            yield as_batch(window.take(rows), rows, mirrored[start : start + batch])

    def _shuffled_blocks(
        self, generator: np.random.Generator
    ) -> list[tuple[NDArray[np.int64], Int64]]:
        """Return blocks of BUFFER shards in random order, each with all its rows in random
        order.
        """
        rows_of = [
            np.arange(end - len(shard.seeds), end)
            for shard, end in zip(self.shards, self.ends, strict=True)
        ]
        order = generator.permutation(len(self.shards))
        blocks = [order[k : k + BUFFER] for k in range(0, len(order), BUFFER)]
        rows = [np.concatenate([rows_of[shard] for shard in some]) for some in blocks]
        return [(some, generator.permutation(own)) for some, own in zip(blocks, rows, strict=True)]

    @property
    def ends(self) -> list[int]:
        """The row after each shard's last."""
        return [*accumulate(len(shard.seeds) for shard in self.shards)]


class _Window:
    """Shards in memory during one epoch: each is read once, and dropped after the last batch of its
    block.
    """

    def __init__(self, dataset: Dataset, blocks: list[NDArray[np.int64]]) -> None:
        self._dataset = dataset
        self._ends = dataset.ends
        self._block = {
            int(shard): number for number, shards in enumerate(blocks) for shard in shards
        }
        self._held: dict[int, list[NDArray[Any]]] = {}

    def take(self, rows: Int64) -> MapSet:
        """Return the maps and images of some rows, in their order."""
        shards = np.searchsorted(self._ends, rows, side="right")
        wanted = [int(shard) for shard in np.unique(shards)]
        oldest = min((self._block[shard] for shard in wanted), default=0)
        self._held = {
            shard: maps for shard, maps in self._held.items() if self._block[shard] >= oldest
        }
        for shard in wanted:
            if shard not in self._held:
                self._held[shard] = self._dataset.read(self._dataset.shards[shard])
        arrays = [np.empty((len(rows), *of.shape[1:]), of.dtype) for of in self._held[wanted[0]]]
        for shard in wanted:
            here = shards == shard
            within = rows[here] - (self._ends[shard] - len(self._dataset.shards[shard].seeds))
            for target, source in zip(arrays, self._held[shard], strict=True):
                target[here] = source[within]
        return MapSet(*arrays)


def check_held_out(training: Dataset, held_out: Dataset) -> None:
    """Raise SceneError where held-out objects are training objects: in the same folder, rendered
    from the same seeds, or the same frames of recordings.
    """
    if training.folder.resolve() == held_out.folder.resolve():
        raise SceneError(
            f"--dataset and --held-out are the same folder ({training.folder}): hold out different"
            " objects"
        )
    recorded = [each.plan.accuracy == RECORDED for each in (training, held_out)]
    if all(recorded):
        _check_recordings(training, held_out)
    if any(recorded):
        return  # their seeds number frames
    objects = training.plan.objects, held_out.plan.objects
    have_generic = all(each.share_generic > 0 for each in objects)
    # With other meshes a seed is another object, unless it is a generic shape, which follows from
    # the seed alone.
    if objects[0].meshes != objects[1].meshes and not have_generic:
        return
    both = training.seeds & held_out.seeds
    if both:
        raise SceneError(
            f"{len(both)} objects of {held_out.folder} have the seeds of objects in"
            f" {training.folder}, from {min(both)}: build the held-out ones with another --seed"
        )


def _check_recordings(training: Dataset, held_out: Dataset) -> None:
    """Raise SceneError where two datasets of recordings hold the same frames."""
    known, judged = (
        {sha256(depth_m.tobytes()).digest() for depth_m in each.column("depth_m")}
        for each in (training, held_out)
    )
    if both := known & judged:
        raise SceneError(
            f"{len(both)} frames of {held_out.folder} are in {training.folder} too: hold out"
            " recordings of other objects"
        )


def open_dataset(
    folder: Path, *, color: bool = False, expected: bool = False, locked: bool = False
) -> Dataset:
    """Open a folder's dataset, of depth or in color; one of expected maps only where `expected`
    maps will do, one of `locked` differences only where these will.

    Raises RecordingError where there is none, one of another kind, or shards of two datasets.
    """
    if not (shards := shards_of(folder)):
        raise RecordingError(
            f"no dataset in {folder}: it holds no shard-*.h5; make one with `nlos-cam dataset"
            " build`"
        )
    plan = shards[0].plan
    for shard in shards[1:]:
        if shard.provenance != shards[0].provenance and shard.plan != plan:
            raise RecordingError(
                f"{shard.path} is of another dataset than {shards[0].path.name}: remove one of them"
            )
    if plan.accuracy == LOCKED and not locked:
        raise RecordingError(
            f"{folder} holds locked differences (`adapt --frames`), which are no maps: give another"
            " dataset"
        )
    if plan.textures and not color:
        raise RecordingError(
            f"{folder} holds a dataset in color ({SIMULATION_ONLY}): give one of depth"
        )
    if plan.expected and not expected:
        raise RecordingError(
            f"{folder} holds expected maps, to which only training on raw maps adds noise: make"
            " them without --expected-maps"
        )
    if color and not plan.textures:
        raise RecordingError(
            f"{folder} holds a dataset of depth: make one in color with `nlos-cam dataset build"
            " --colour`"
        )
    return Dataset(folder, plan, tuple(shards))
