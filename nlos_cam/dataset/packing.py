"""Rows that the packed maps hold of a shard, made by this process or by others beside it."""

import signal
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from threading import Thread
from typing import Self

import numpy as np
import torch
from nlos_calibration import Rig, rig_difference
from nlos_calibration.arrays import Float32, Mask
from nlos_models import CellNormal, CheckpointRecord, channels_of
from nlos_models.arrays import Float16
from nlos_models.training import MapSet

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.reader import MAP_CHANNELS
from nlos_cam.dataset.shards import Shard, read_arrays, read_head
from nlos_cam.dataset.worker import AHEAD, end_with_parent
from nlos_cam.errors import WorkersLostError
from nlos_cam.processes import safe_children
from nlos_cam.reconstruct import align_samples, is_wall_grid, own_rig

MAPS = "maps.f16"
IMAGES = "images.f16"
COUNTS = "counts.f16"


@dataclass(frozen=True)
class Packer:
    """What decides the rows of a shard."""

    maps_rig: Rig
    """Rig that the maps are aligned with."""
    cells: Mapping[str, Float32]
    """State of the normalisation. Arrays, since tensors go to other processes as open files, by a
    thread that stays.
    """
    with_counts: bool
    """Keep the bench's own counts, for noise of light that alignment has scaled."""

    @classmethod
    def of(cls, maps_rig: Rig, normal: CellNormal, *, with_counts: bool) -> Self:
        """Return the packer of a normalisation."""
        cells = {name: values.numpy() for name, values in normal.state_dict().items()}
        return cls(maps_rig, cells, with_counts)

    def rows(self, path: Path) -> dict[str, Float16]:
        """Return a shard's rows (n, ...) by the name of their file in the store."""
        maps, counts = read_aligned(read_head(path), self.maps_rig)
        pair = torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)
        rows = {MAPS: self._normal()(*pair).half().numpy(), IMAGES: maps.image.astype(np.float16)}
        if self.with_counts:
            rows[COUNTS] = np.log1p(counts).astype(np.float16)
        return rows

    def _normal(self) -> CellNormal:
        normal = CellNormal(color=len(self.cells["median"]) == channels_of(color=True))
        normal.load_state_dict(
            {name: torch.from_numpy(values) for name, values in self.cells.items()}
        )
        return normal


def read_aligned(shard: Shard, maps_rig: Rig) -> tuple[MapSet, Float32]:
    """Return a shard's samples as a rig sees them, and the bench's own counts behind them."""
    maps = MapSet(*read_arrays(shard, MAP_CHANNELS))
    maps, _, counts = aligned_with(maps, map(shard.plan.known_rig, shard.seeds), maps_rig)
    return maps, counts


def aligned_with(maps: MapSet, benches: Iterable[Rig], rig: Rig) -> tuple[MapSet, Mask, Float32]:
    """Return samples as a rig sees them, less those of benches that cannot be aligned with it; the
    mask of those that are left; and the benches' own intensities (n, 64, 80) behind them.
    """
    maps, seen, counts = align_samples(maps, benches, rig)
    return kept_of(maps, seen), seen, counts[seen]


def rig_of_weights(
    plan: DatasetPlan, maps_rig: Rig, trained: CheckpointRecord | None = None
) -> Rig:
    """Return the rig that weights are for, which maps of a dataset train: the one that the maps are
    aligned with; on the wall grid the bench that they are of, as the start weights `trained` know
    it where it is theirs, and the grid itself for a plan of many rigs.
    """
    if not is_wall_grid(maps_rig) or plan.rigs:
        return maps_rig
    known = own_rig(trained) if trained else None
    return known if known and not rig_difference(plan.rig, known) else plan.rig


def kept_of(maps: MapSet, kept: Mask) -> MapSet:
    """Return the samples that a mask (n,) keeps."""
    return MapSet(*(getattr(maps, name)[kept] for name in MAP_CHANNELS))


class Packing:
    """Processes that make the rows of shards; one is this process itself."""

    def __init__(self, processes: int) -> None:
        self._processes = processes
        self._pool: ProcessPoolExecutor | None = None

    def rows_of(self, packer: Packer, paths: Sequence[Path]) -> Iterator[dict[str, Float16]]:
        """Yield the rows of each shard, in order. Raises WorkersLostError where a process ends."""
        if self._processes == 1 or len(paths) < 2:  # others would take longer to begin
            yield from map(packer.rows, paths)
            return
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                self._processes, mp_context=get_context("spawn"), initializer=_begin
            )
        # The rows of a shard take megabytes: only a few are made before they are asked for.
        left = iter(paths)
        ahead = AHEAD * self._processes
        made: deque[Future[dict[str, Float16]]] = deque()
        try:
            while True:
                with safe_children():
                    for path in islice(left, ahead - len(made)):
                        made.append(self._pool.submit(_rows, packer, path))
                if not made:
                    return
                yield made.popleft().result()
        except BrokenProcessPool as error:
            raise WorkersLostError(
                "a process that packs maps ended: free memory, or lower --pack-workers"
            ) from error

    def close(self) -> None:
        """End the processes, whatever they do."""
        if self._pool:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


@contextmanager
def packing(processes: int) -> Generator[Packing]:
    """Open processes that pack, until the end of the block."""
    opened = Packing(processes)
    try:
        yield opened
    finally:
        opened.close()


def _rows(packer: Packer, path: Path) -> dict[str, Float16]:
    return packer.rows(path)


def _begin() -> None:
    """Set up a process that packs: one thread, no reaction to Ctrl-C, an end with its parent."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=end_with_parent, daemon=True).start()
