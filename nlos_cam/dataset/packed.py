"""Packed store of datasets for the direct network: normalised maps and images in float16, mapped
into memory.

A store grows: shards that appear in the datasets are added when an epoch begins. It keeps the
number of objects of every epoch, so that an interrupted run sees the same batches again. It knows
its datasets and the rig that their maps are aligned with, and serves no others (`packed_index`).
"""

import hashlib
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from nlos_calibration import Rig
from nlos_models import CellNormal, CheckpointRecord, channels_of
from nlos_models.arrays import Float16
from nlos_models.training import MapNoise, MapSet, NormalBatch, Recipe, record_run

from nlos_cam.dataset.growing import FoundShard, GrowingDatasets
from nlos_cam.dataset.packed_index import StoreIndex, damaged
from nlos_cam.dataset.packing import (
    COUNTS,
    IMAGES,
    MAPS,
    Packer,
    Packing,
    aligned_with,
    packing,
    read_aligned,
    rig_of_weights,
)
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.reader import MAP_CHANNELS
from nlos_cam.dataset.samples import OnProgress, ignore
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.files import atomic_file, claim
from nlos_cam.files import read_arrays as read_npz
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.reconstruct import WALL_GRID, is_wall_grid, recorded_counts, rig_fields

CELLS = "cells.npz"
STATISTICS_SHARDS = 40
"""Shards of each dataset that the cells' statistics are taken from: 4,000 objects."""


@dataclass(frozen=True, kw_only=True)
class StoreOptions:
    """What a training run asks of a store."""

    normal: CellNormal | None = None
    """Normalisation of the weights that training goes on from. None: one fitted to the first
    shards.
    """
    trained: CheckpointRecord | None = None
    """Record of those weights. Where they are of another rig than the maps are aligned with, their
    normalisation is not taken.
    """
    color: bool = False
    """Maps and images in color."""
    shards: int | None = None
    """Shards of each epoch and of the statistics, the first ones, so that a killed run fits the
    same normalisation again. None: all that are there.
    """
    maps_rig: Rig | None = None
    """Rig that the maps are aligned with. None: the plan's, or the wall grid for a plan of many
    rigs.
    """
    run: str = ""
    """Name of the training run, which has epochs of its own in a store that runs share."""
    locked: bool = False
    """Take datasets of locked differences."""
    held_out: Path | None = None
    """Dataset whose objects must not be among those of training: looked for before anything is
    packed.
    """
    pack_now: bool = True
    """Pack what is there on opening, unless `shards` is given. False: by `refresh`, or when the
    first epoch begins.
    """


def map_noise(plan: DatasetPlan) -> MapNoise:
    """Return the noise of a map cell's intensity by the plan's sensor."""
    sensor = plan.sensor
    pixels = plan.rig.intrinsics.height * plan.rig.intrinsics.width
    alive = (1 - sensor.dead_share) * pixels / (MAP_ROWS * MAP_COLUMNS)
    return MapNoise(sensor.read_noise_counts**2, sensor.shot_noise**2, sensor.ambient_counts, alive)


class PackedMaps:
    """Normalised maps and images of one or more datasets of one rig, in a folder that is theirs
    alone.

    A spread that the benches' records do not hold (`DatasetPlan.known_rig`) stays in the maps.
    """

    def __init__(
        self, data: GrowingDatasets, store: Path, options: StoreOptions, packing: Packing
    ) -> None:
        """Open or make the store: use `open_packed_maps`, which claims its folder.

        New shards are packed by the processes of `packing`. Raises SceneError for a store of other
        data, aligned with another rig, or normalised otherwise.
        """
        self.plan: DatasetPlan = data.plan
        """Of the first dataset."""
        self.maps_rig: Rig = options.maps_rig or (WALL_GRID if data.plan.rigs else data.plan.rig)
        """Rig that the maps are aligned with."""
        self.noise: MapNoise | None = map_noise(data.plan) if data.plan.expected else None
        """To be drawn at each step of training."""
        self._data = data
        self._store = store
        self._options = options
        self._packing = packing
        self._rows = self._row_shapes()

        self._index = StoreIndex.read(store)
        self._index.open_for(self.maps_rig, data.opened, data.keys)
        self.normal: CellNormal = self._open_normal()

        if options.shards is None and options.pack_now:
            self.refresh()

    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of an object's row in each file of the store."""
        color = self._options.color
        pixels = (OBJECT_PIXELS, OBJECT_PIXELS)
        shapes: dict[str, tuple[int, ...]] = {
            MAPS: (channels_of(color=color), MAP_ROWS, MAP_COLUMNS),
            IMAGES: (3, *pixels) if color else pixels,
        }
        if self._stores_counts:
            shapes[COUNTS] = MAP_ROWS, MAP_COLUMNS
        return shapes

    def _open_normal(self) -> CellNormal:
        """Return the store's normalisation; a new store gets that of the start weights, or the one
        of its first shards' statistics. Raises SceneError where the store has another.
        """
        given = self._options.normal
        trained = self._options.trained
        # By another rig's statistics a third of the cells would lie beyond the limit of a
        # normalised one, on a bench 5 cm nearer: its layers serve, not its cells. The wall grid
        # counts as another rig, also beside the rig that its maps are drawn around.
        is_foreign = trained is not None and trained.rig_checksum != self.maps_rig.checksum
        wanted = None if is_foreign else given

        if not (self._store / CELLS).exists():
            _write_normal(self._store, wanted or self._learned_normal())
        normal = _read_normal(self._store, color=self._options.color)

        # Stores from before 2026-11-28 may hold the normalisation of another rig's weights.
        holds_foreign = is_foreign and given is not None and _alike(given, normal)
        if holds_foreign or (wanted and not _alike(wanted, normal)):
            raise SceneError(
                f"{self._store} holds maps that are normalised for other weights: name another"
                " --store"
            )
        return normal

    def _learned_normal(self) -> CellNormal:
        """Return the normalisation by the first shards' statistics."""
        count = min(STATISTICS_SHARDS, self._options.shards or STATISTICS_SHARDS)
        some = [
            read_aligned(shard, self.maps_rig)[0]
            for dataset in self._data.opened
            for shard in dataset.shards[:count]
        ]
        depth_m, intensity = ([getattr(one, name) for one in some] for name in MAP_CHANNELS[:2])
        normal = CellNormal(color=self._options.color)
        normal.learn(*(torch.from_numpy(np.concatenate(parts)) for parts in (depth_m, intensity)))
        return normal

    def __len__(self) -> int:
        return sum(self._index.shards.values())

    @property
    def digest(self) -> str:
        """SHA-256 of the rig and of the cells' statistics: a run with others cannot be resumed."""
        return hashlib.sha256(
            self.maps_rig.checksum.encode() + (self._store / CELLS).read_bytes()
        ).hexdigest()

    @property
    def _stores_counts(self) -> bool:
        """True where noise is drawn of light that alignment has scaled."""
        return self.noise is not None and is_wall_grid(self.maps_rig)

    def refresh(self, on_progress: OnProgress = ignore, shards: int | None = None) -> None:
        """Add the shards that appeared in the datasets since the last time, of the first `shards`
        where that is given; of one that has grown since, its further objects.

        Raises SceneError where these are held-out objects.
        """
        by_key = {shard.key: shard for shard in self._data.shards(shards)}
        new = [shard for shard in by_key.values() if self._index.lacks(shard.key, shard.objects)]
        self._drop_rows_beyond_the_index()

        packer = Packer.of(self.maps_rig, self.normal, with_counts=self._stores_counts)
        every = zip(new, self._packing.rows_of(packer, [one.path for one in new]), strict=True)
        for number, (shard, rows) in enumerate(every, 1):
            self._append(shard, rows)
            if number % 50 == 0 or number == len(new):
                self._index.write()
            on_progress(number, len(new))

    def _drop_rows_beyond_the_index(self) -> None:
        """Cut off the rows that an interruption left after the last indexed one. Raises
        RecordingError where rows are missing.
        """
        for name, shape in self._rows.items():
            path = self._store / name
            size = np.dtype(np.float16).itemsize * len(self) * int(np.prod(shape))
            path.touch()
            if path.stat().st_size < size:
                raise damaged(self._store, name)
            with path.open("r+b") as file:
                file.truncate(size)

    def _append(self, shard: FoundShard, rows: Mapping[str, Float16]) -> None:
        """Add a shard's rows, by the name of their file, that the store does not hold yet."""
        # A shard grows by further seeds, whose order packing keeps: its first rows are there.
        packed = self._index.shards.get(shard.key, 0)
        for name, values in rows.items():
            with (self._store / name).open("ab") as file:
                file.write(np.ascontiguousarray(values[packed:]).tobytes())
        self._index.shards[shard.key] = len(rows[IMAGES])
        self._index.sizes[shard.key] = shard.objects

    def held_out(self, folder: Path, count: int) -> MapSet:
        """Return up to `count` samples of another dataset as the store has its own: aligned with
        the same rig.

        Raises SceneError for a dataset of the same objects, or of benches that cannot be aligned.
        """
        opened = self._data.hold_out(folder)
        maps = aligned_with(opened.first(count), opened.benches(), self.maps_rig)[0]
        if not len(maps.image):
            raise SceneError(
                f"no object of {folder} can be aligned with {self.maps_rig.name}: its box has another"
                " size, or its occluder hides more; hold out objects of the same rig"
            )
        return maps

    def record_run(
        self, recipe: Recipe, out: Path, runs: list[Recipe], *starts: Path | None
    ) -> CheckpointRecord:
        """Return the record of the weights that a recipe makes of these maps after `runs`. Raises
        OutputExistsError as `nlos_models.training.record_run`.
        """
        on_grid = is_wall_grid(self.maps_rig)
        rig = rig_of_weights(self.plan, self.maps_rig)
        # Light of the wall grid, and of aligned maps, is that of the simulated sensor.
        is_own = not on_grid and self.plan.stays_in_maps
        return record_run(
            recipe,
            out,
            (rig.name, self.maps_rig.checksum),
            runs,
            *starts,
            bench=rig_fields(rig, packaged=on_grid),
            bare_wall_counts=recorded_counts(self.plan.sensor) if is_own else None,
        )

    def forget_run(self) -> None:
        """Forget how many objects the epochs of this run saw: it begins again."""
        run = self._options.run
        if not run:
            return
        # The key of an epoch is its run, a path and a blank, followed by the epoch's seed. The
        # path of another run may begin with the same text.
        epochs = self._index.epochs
        for key in [key for key in epochs if key.startswith(run)]:
            if key.removeprefix(run).isdigit():
                del epochs[key]
        self._index.write()

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[NormalBatch]:
        """Yield one pass over the objects in random order, without the last, smaller batch.

        A generator's first pass in a run adds new shards; a generator of the same seed sees the
        same objects again in that run.
        """
        key = f"{self._options.run}{generator.initial_seed()}"
        epochs = self._index.epochs
        if key not in epochs:
            self.refresh(shards=self._options.shards)
            epochs[key] = len(self)
            self._index.write()
        count = int(epochs[key])
        if count < batch:
            raise RecordingError(
                f"{count} objects are fewer than a batch of {batch}: build more, or lower batch"
            )
        files = [
            np.memmap(self._store / name, np.float16, "r", shape=(count, *shape))
            for name, shape in self._rows.items()
        ]
        order = torch.randperm(count, generator=generator).numpy()
        for start in range(0, count - batch + 1, batch):
            rows = np.sort(order[start : start + batch])
            yield NormalBatch(*(torch.from_numpy(file[rows]) for file in files))


def _alike(one: CellNormal, other: CellNormal) -> bool:
    """Return whether two normalisations are the same."""
    found = other.state_dict()
    return all(torch.equal(values, found[name]) for name, values in one.state_dict().items())


def _write_normal(store: Path, normal: CellNormal) -> None:
    cells = {name: values.numpy() for name, values in normal.state_dict().items()}
    with atomic_file(store / CELLS) as part, part.open("wb") as file:
        np.savez(file, **cells)


def _read_normal(store: Path, *, color: bool) -> CellNormal:
    """Return a store's normalisation. Raises RecordingError where its file is damaged."""
    normal = CellNormal(color=color)
    try:
        cells = read_npz(store / CELLS)
        normal.load_state_dict({name: torch.from_numpy(values) for name, values in cells.items()})
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise damaged(store, CELLS) from error
    return normal


@contextmanager
def open_packed_maps(
    datasets: Sequence[Path],
    store: Path,
    options: StoreOptions | None = None,
    *,
    processes: int = 1,
) -> Generator[PackedMaps]:
    """Open or make a store, and hold the right to write it until the end of the block.

    New shards are packed by so many `processes`. Raises FileBusyError while another process holds
    the store, RecordingError where a folder is not a dataset, SceneError for datasets of two kinds
    and for held-out objects that are training objects, and the errors of PackedMaps.
    """
    options = options or StoreOptions()
    store.mkdir(parents=True, exist_ok=True)
    with claim(store, inside=True), packing(processes) as made_ready:
        data = GrowingDatasets(datasets, color=options.color, locked=options.locked)
        if options.held_out:
            data.hold_out(options.held_out)
        yield PackedMaps(data, store, options, made_ready)
