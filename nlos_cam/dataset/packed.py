"""Packed store of datasets for the direct network: normalised maps and images in float16, mapped
into memory.

A store grows: shards that appear in the datasets are added when an epoch begins. It keeps the
number of objects of every epoch, so that an interrupted run sees the same batches again. It knows
its datasets and the rig that their maps are aligned with, and serves no others (`packed_index`).
"""

import hashlib
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from nlos_calibration import Rig
from nlos_models import CellNormal, CheckpointRecord, channels_of
from nlos_models.training import MapNoise, MapSet, NormalBatch, Recipe, record_run

from nlos_cam.dataset.build import SHARD
from nlos_cam.dataset.packed_index import StoreIndex, damaged, shard_key
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
from nlos_cam.dataset.plan import DatasetPlan, RigSpread
from nlos_cam.dataset.reader import MAP_CHANNELS, Dataset, check_held_out, open_dataset
from nlos_cam.dataset.rig_range import RigRange
from nlos_cam.dataset.samples import OnProgress, ignore
from nlos_cam.dataset.shards import SHARD_PATTERN, read_head
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.files import atomic_file, claim
from nlos_cam.files import read_arrays as read_npz
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.reconstruct import WALL_GRID, is_wall_grid, recorded_counts, rig_fields
from nlos_cam.render import Material, SensorModel

CELLS = "cells.npz"
STATISTICS_SHARDS = 40
"""Shards of each dataset that the cells' statistics are taken from: 4,000 objects."""


def map_noise(plan: DatasetPlan) -> MapNoise:
    """Return the noise of a map cell's intensity by the plan's sensor."""
    sensor = plan.sensor
    pixels = plan.rig.intrinsics.height * plan.rig.intrinsics.width
    alive = (1 - sensor.dead_share) * pixels / (MAP_ROWS * MAP_COLUMNS)
    return MapNoise(sensor.read_noise_counts**2, sensor.shot_noise**2, sensor.ambient_counts, alive)


class PackedMaps:
    """Normalised maps and images of one or more datasets of one rig, in a folder that is theirs
    alone.
    """

    def __init__(
        self,
        datasets: Sequence[Path],
        store: Path,
        normal: CellNormal | None = None,
        *,
        trained: CheckpointRecord | None = None,
        color: bool = False,
        shards: int | None = None,
        maps_rig: Rig | None = None,
        run: str = "",
        packing: Packing | None = None,
        locked: bool = False,
        held_out: Path | None = None,
        pack_now: bool = True,
    ) -> None:
        """Open or make the store: use `open_packed_maps`, which claims its folder.

        Normalisation: `normal`, unless it belongs to weights `trained` for another rig than the
        maps are aligned with. Else it is fitted to the first shards; with `shards`, to no others
        than these, so that a killed run fits the same one again.

        Objects of an epoch: the first `shards`, by default all that are there. Those are packed at
        once, unless `pack_now` is False: then by `refresh`, or when the first epoch begins.
        `run` names the training run, which has epochs of its own in a store that runs share.

        Alignment: with the rig `maps_rig`, by default the plan's, or the wall grid for a plan of
        many rigs. A spread that the benches' records do not hold (`DatasetPlan.known_rig`) stays in the
        maps.

        New shards are packed by the processes of `packing`, by default by this one. Datasets of
        locked differences are refused unless `locked`. A dataset `held_out` is checked before
        anything is packed.

        Raises RecordingError for no dataset, SceneError for datasets of two rigs, for held-out
        objects that are training objects, and for a store of other data, aligned with another rig,
        or normalised otherwise.
        """
        opened = [
            open_dataset(folder, color=color, expected=True, locked=locked) for folder in datasets
        ]
        self.plan: DatasetPlan = opened[0].plan
        """Of the first dataset."""
        _check_of_one_kind(opened)
        self.maps_rig: Rig = maps_rig or (WALL_GRID if self.plan.rigs else self.plan.rig)
        """Rig that the maps are aligned with."""
        # By another rig's statistics a third of the cells would lie beyond the limit of a
        # normalised one, on a bench 5 cm nearer: its layers serve, not its cells. The wall grid
        # counts as another rig, also beside the rig that its maps are drawn around.
        is_foreign = trained is not None and trained.rig_checksum != self.maps_rig.checksum
        wanted = None if is_foreign else normal

        self.noise: MapNoise | None = map_noise(self.plan) if self.plan.expected else None
        """To be drawn at each step of training."""
        self._datasets = list(datasets)
        self._opened = opened
        self._store = store
        self._shards = shards
        self._run = run
        self._packing = packing or Packing(1)
        self.normal = CellNormal(color=color)

        if color and self.plan.spread != RigSpread():
            raise SceneError(
                f"{datasets[0]} varies the rig, but maps in color are not aligned: build it without"
                " a spread"
            )
        self._color = color
        self._locked = locked
        self._held_out: Dataset | None = None
        """Compared with all shards, also with those that appear later."""
        if held_out:
            self._open_held_out(held_out)

        pixels = (OBJECT_PIXELS, OBJECT_PIXELS)
        self._rows: dict[str, tuple[int, ...]] = {
            MAPS: (channels_of(color=color), MAP_ROWS, MAP_COLUMNS),
            IMAGES: (3, *pixels) if color else pixels,
        }
        if self._stores_counts:
            self._rows[COUNTS] = MAP_ROWS, MAP_COLUMNS

        there = [shard for one in opened for shard in one.shards]
        self._keys = {shard.path: shard_key(shard) for shard in there}
        self._sizes = {shard.path: len(shard.seeds) for shard in there}
        self._index = StoreIndex.read(store)
        self._index.open_for(self.maps_rig, opened, self._keys)

        if not (store / CELLS).exists():
            self._write_cells(opened, wanted)
        try:
            cells = read_npz(store / CELLS)
            self.normal.load_state_dict(
                {name: torch.from_numpy(values) for name, values in cells.items()}
            )
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            raise damaged(store, CELLS) from error
        # Stores from before 2026-11-28 may hold the normalisation of another rig's weights.
        holds_foreign = is_foreign and normal is not None and _alike(normal, self.normal)
        if holds_foreign or (wanted and not _alike(wanted, self.normal)):
            raise SceneError(
                f"{store} holds maps that are normalised for other weights: name another --store"
            )
        if shards is None and pack_now:
            self.refresh()

    def _write_cells(self, opened: Sequence[Dataset], normal: CellNormal | None) -> None:
        """Write a normalisation to the store, or that of the first shards' statistics."""
        if normal:
            self.normal.load_state_dict(normal.state_dict())
        else:
            shards = min(STATISTICS_SHARDS, self._shards or STATISTICS_SHARDS)
            some = [
                read_aligned(shard, self.maps_rig)[0]
                for one in opened
                for shard in one.shards[:shards]
            ]
            depth_m, intensity = ([getattr(one, name) for one in some] for name in MAP_CHANNELS[:2])
            self.normal.learn(
                *(torch.from_numpy(np.concatenate(parts)) for parts in (depth_m, intensity))
            )
        with atomic_file(self._store / CELLS) as part, part.open("wb") as file:
            np.savez(
                file,
                **{name: values.numpy() for name, values in self.normal.state_dict().items()},
            )

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
        index = self._index
        known = index.shards
        paths = [path for folder in self._datasets for path in sorted(folder.glob(SHARD_PATTERN))]
        keys = {self._key(path): path for path in paths[:shards]}
        new = {key: path for key, path in keys.items() if index.lacks(key, self._sizes[path])}
        for name, shape in self._rows.items():
            path = self._store / name
            size = 2 * len(self) * int(np.prod(shape))
            path.touch()
            if path.stat().st_size < size:
                raise damaged(self._store, name)
            # Rows after the last indexed one were left by an interruption.
            with path.open("r+b") as file:
                file.truncate(size)
        packer = Packer.of(self.maps_rig, self.normal, with_counts=self._stores_counts)
        every = zip(new, self._packing.rows_of(packer, [*new.values()]), strict=True)
        for number, (key, columns) in enumerate(every, 1):
            # A shard grows by further seeds, whose order packing keeps: its first rows are there.
            packed = known.get(key, 0)
            for name, values in columns.items():
                with (self._store / name).open("ab") as file:
                    file.write(np.ascontiguousarray(values[packed:]).tobytes())
            known[key] = len(columns[IMAGES])
            index.sizes[key] = self._sizes[new[key]]
            if number % 50 == 0 or number == len(new):
                index.write()
            on_progress(number, len(new))

    def _key(self, path: Path) -> str:
        """Return the `shard_key` of a shard, which is read once, its head until it is full. Raises
        SceneError where it has grown by held-out objects.
        """
        known = self._sizes.get(path, 0)
        if known < SHARD:
            head = read_head(path)
            if self._held_out and len(head.seeds) > known:
                check_held_out(Dataset(path.parent, head.plan, (head,)), self._held_out)
            self._sizes[path] = len(head.seeds)
            if path not in self._keys:
                self._keys[path] = shard_key(head)
        return self._keys[path]

    def held_out(self, folder: Path, count: int) -> MapSet:
        """Return up to `count` samples of another dataset as the store has its own: aligned with
        the same rig.

        Raises SceneError for a dataset of the same objects, or of benches that cannot be aligned.
        """
        opened = self._open_held_out(folder)
        maps = aligned_with(opened.first(count), opened.benches(), self.maps_rig)[0]
        if not len(maps.image):
            raise SceneError(
                f"no object of {folder} can be aligned with {self.maps_rig.name}: its box has another"
                " size, or its occluder hides more; hold out objects of the same rig"
            )
        return maps

    def _open_held_out(self, folder: Path) -> Dataset:
        opened = open_dataset(folder, color=self._color, locked=self._locked)
        for training in self._opened:
            check_held_out(training, opened)
        self._held_out = opened
        return opened

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
        if self._run:
            epochs = self._index.epochs
            # The key of an epoch is its run, a path and a blank, followed by the epoch's seed. The
            # path of another run may begin with the same text.
            for key in list(epochs):
                if key.startswith(self._run) and key[len(self._run) :].isdigit():
                    del epochs[key]
            self._index.write()

    def batches(self, batch: int, generator: torch.Generator) -> Iterator[NormalBatch]:
        """Yield one pass over the objects in random order, without the last, smaller batch.

        A generator's first pass in a run adds new shards; a generator of the same seed sees the
        same objects again in that run.
        """
        key = f"{self._run}{generator.initial_seed()}"
        epochs = self._index.epochs
        if key not in epochs:
            self.refresh(shards=self._shards)
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


def _check_of_one_kind(opened: Sequence[Dataset]) -> None:
    """Raise SceneError for datasets of two rigs or sensors, or with and without noise."""
    first = opened[0]
    for other in opened[1:]:
        both = f"{other.folder} and {first.folder}"
        if _rigs_of(other.plan) != _rigs_of(first.plan):
            raise SceneError(f"{both} were rendered for different rigs: give datasets of one")
        if other.plan.expected != first.plan.expected:
            raise SceneError(f"of {both} one holds expected maps, without noise: give one kind")
        # the noise that training adds is that of one sensor
        if _light_of(other.plan) != _light_of(first.plan):
            raise SceneError(
                f"{both} differ in sensor, radiometry or material: give datasets of one kind"
            )


def _light_of(plan: DatasetPlan) -> tuple[SensorModel, str, Material]:
    return plan.sensor, plan.radiometry, plan.material


def _rigs_of(plan: DatasetPlan) -> tuple[Rig, RigRange | None]:
    return plan.rig, plan.rigs


@contextmanager
def open_packed_maps(
    datasets: Sequence[Path],
    store: Path,
    normal: CellNormal | None = None,
    *,
    trained: CheckpointRecord | None = None,
    color: bool = False,
    shards: int | None = None,
    maps_rig: Rig | None = None,
    run: str = "",
    processes: int = 1,
    locked: bool = False,
    held_out: Path | None = None,
    pack_now: bool = True,
) -> Generator[PackedMaps]:
    """Open or make a store, and hold the right to write it until the end of the block.

    New shards are packed by so many `processes`. Raises FileBusyError while another process holds
    the store, and the errors of PackedMaps.
    """
    store.mkdir(parents=True, exist_ok=True)
    with claim(store, inside=True), packing(processes) as made_ready:
        yield PackedMaps(
            datasets,
            store,
            normal,
            trained=trained,
            color=color,
            shards=shards,
            maps_rig=maps_rig,
            run=run,
            packing=made_ready,
            locked=locked,
            held_out=held_out,
            pack_now=pack_now,
        )
