"""Builder of datasets: random objects, rendered into HDF5 shards of lidar maps and images;
resumable at any time.

Workers make samples and one process writes them. A shard appears under its name only when it is
complete; building again makes only missing or damaged shards. A sample depends on its seed alone,
so any workers make equal shards.
"""

import time
from collections import deque
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for_any
from pathlib import Path

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import OnProgress, Samples, ignore, join_samples, make_samples
from nlos_cam.dataset.shards import (
    SHARD_PATTERN,
    Shard,
    check_arrays,
    only_builder,
    read_head,
    shard_path,
    store,
)
from nlos_cam.dataset.worker import Worker
from nlos_cam.errors import OutputExistsError, RecordingError, SceneError, WorkersLostError

TRAINING_SEED = 0
HELD_OUT_SEED = 10_000_000
TEST_SEED = 20_000_000
"""First seeds: no training run reaches the seeds of held-out and test objects; see `check_seeds`."""
SEEDS_END = 1_000_000_000
"""First seed that no object has: names of shards, which are in the order of seeds, have 9 digits."""
SHARD = 100
"""Objects in a shard: as many can be lost of each unfinished shard when a build is killed."""
PIECE = 10
"""Objects that a worker makes at a time."""

Pieces = Generator[tuple[range, Samples]]
Farm = Callable[[DatasetPlan, Sequence[range]], Pieces]
"""Makes the samples of ranges of seeds and yields them in any order; closing the generator ends its
workers. One that has several may say how many by an attribute `workers`.
"""


@dataclass(frozen=True)
class BuildReport:
    """Result of a build."""

    objects: int
    """Objects in the folder, of those requested."""
    made: int
    """Objects made in this run."""
    seconds: float
    damaged: tuple[Path, ...]
    """Damaged shards that were made again."""

    @property
    def objects_per_s(self) -> float | None:
        """Rate of this run; None where it made nothing."""
        return self.made / self.seconds if self.made else None


def check_seeds(first_seed: int, count: int) -> None:
    """Raise SceneError where objects that begin below the held-out or the test ones reach them, or
    where their seeds are too large.
    """
    if first_seed + count > SEEDS_END:
        raise SceneError(
            f"seeds from {first_seed} on are too large: objects end below {SEEDS_END}, choose another"
            " --seed or a lower --count"
        )
    for name, reserved in (("held-out", HELD_OUT_SEED), ("test", TEST_SEED)):
        if first_seed < reserved < first_seed + count:
            raise SceneError(
                f"seeds {first_seed} to {first_seed + count - 1} reach the {name} objects, from"
                f" {reserved} on: choose another --seed or a lower --count"
            )


def build_dataset(
    plan: DatasetPlan,
    count: int,
    folder: Path,
    *,
    workers: int,
    on_progress: OnProgress,
    on_check: OnProgress = ignore,
    on_warning: Callable[[str], None] = ignore,
    command: str = "",
    farm: Farm | None = None,
) -> BuildReport:
    """Bring a folder up to `count` objects, by `workers` processes on this machine or by another
    `farm`.

    Raises SceneError for seeds that reach reserved ones (`check_seeds`), OutputExistsError for a
    folder of other files, RecordingError for one with shards of another plan, FolderBusyError where
    another build uses it, and DiskFullError and WorkersLostError, with all finished shards kept.
    """
    plan.check()
    check_seeds(plan.first_seed, count)
    if folder.is_dir() and not any(folder.glob(SHARD_PATTERN)) and any(folder.glob("[!.]*")):
        raise OutputExistsError(f"{folder} holds other files and no dataset: choose another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputExistsError(
            f"cannot create the folder {folder} ({error.strerror}): choose another --out"
        ) from error
    with only_builder(folder):
        wanted = [*_split(range(plan.first_seed, plan.first_seed + count), SHARD)]
        damaged = _find_damaged(folder, plan, on_check)
        missing = [seeds for seeds in wanted if not _holds(folder, seeds, damaged)]
        replaced = damaged.keys() & {shard_path(folder, seeds.start) for seeds in missing}
        for path, problem in damaged.items():
            on_warning(f"{path} is damaged and will be made again" if path in replaced else problem)
        start_s = time.perf_counter()
        made = sum(map(len, missing))
        done = count - made
        on_progress(done, count)
        pieces = [piece for seeds in missing for piece in _split(seeds, PIECE)]
        with closing((farm or processes(workers))(plan, pieces)) as samples:
            for seeds in _store_shards(folder, plan.provenance, missing, samples, command):
                done += len(seeds)
                on_progress(done, count)
    return BuildReport(count, made, time.perf_counter() - start_s, tuple(sorted(replaced)))


def _split(seeds: range, size: int) -> Iterator[range]:
    for start in range(seeds.start, seeds.stop, size):
        yield range(start, min(start + size, seeds.stop))


def _find_damaged(folder: Path, plan: DatasetPlan, on_check: OnProgress) -> dict[Path, str]:
    """Return the damaged shards with their problems. Raises RecordingError for shards of another
    plan.
    """
    paths = sorted(folder.glob(SHARD_PATTERN))
    damaged = dict[Path, str]()
    for number, path in enumerate(paths, 1):
        try:
            head = read_head(path)
            check_arrays(head)
        except RecordingError as error:
            damaged[path] = str(error)
        else:
            _check_same_plan(head, plan)
        on_check(number, len(paths))
    return damaged


def _check_same_plan(head: Shard, plan: DatasetPlan) -> None:
    if others := head.plan.differences(plan):
        raise RecordingError(
            f"{head.path} is of a dataset with another {', '.join(others)}: choose another --out"
        )
    if (head.seeds.start - plan.first_seed) % SHARD or len(head.seeds) > SHARD:
        raise RecordingError(
            f"{head.path} holds {len(head.seeds)} objects, not up to {SHARD}: choose another --out"
        )


def _holds(folder: Path, seeds: range, damaged: Container[Path]) -> bool:
    """Return True for an intact shard with all of these objects; the last one of a smaller dataset
    has fewer.
    """
    path = shard_path(folder, seeds.start)
    return path.exists() and path not in damaged and len(read_head(path).seeds) >= len(seeds)


def _store_shards(
    folder: Path, provenance: str, missing: Iterable[range], pieces: Pieces, command: str
) -> Iterator[range]:
    """Yield each piece as it arrives, and store a shard as soon as its last piece is there."""
    shard_of = {seed: seeds for seeds in missing for seed in seeds[::PIECE]}
    waiting: dict[range, dict[int, Samples]] = {}
    for piece, samples in pieces:
        seeds = shard_of[piece.start]
        parts = waiting.setdefault(seeds, {})
        parts[piece.start] = samples
        if sum(len(part["seed"]) for part in parts.values()) == len(seeds):
            shard = join_samples([parts[start] for start in sorted(parts)])
            store(shard_path(folder, seeds.start), shard, provenance, command)
            del waiting[seeds]
        yield piece


def in_batches(backend: str) -> Farm:
    """Return a farm that renders in this process, a piece at a time, by a backend of the renderer:
    `torch` or `cuda`.

    Raises SceneError, when it begins, where that backend is missing.
    """

    def make(plan: DatasetPlan, pieces: Sequence[range]) -> Pieces:
        for piece in pieces:
            yield piece, make_samples(plan, piece, backend)

    return make


def processes(workers: int) -> Farm:
    """Return a farm of processes on this machine; dead ones are replaced, until more than it has
    die in a row.
    """

    def make(plan: DatasetPlan, pieces: Sequence[range]) -> Pieces:
        left = deque(pieces)
        farm = dict[Connection, Worker]()
        dismissed: list[Worker] = []
        lost = 0
        try:
            while left or farm:
                while left and len(farm) < workers:
                    worker = Worker(plan, left)
                    farm[worker.pipe] = worker
                for worker in [
                    farm[pipe] for pipe in wait_for_any([*farm]) if isinstance(pipe, Connection)
                ]:
                    made = worker.take(left)
                    lost = 0 if made else lost + 1
                    if lost > workers:
                        raise WorkersLostError(
                            f"a worker exited (code {worker.end()}) before producing {PIECE}"
                            " objects: finished shards are kept; free memory or lower --workers,"
                            " and build again"
                        )
                    if not worker.asked:
                        del farm[worker.pipe]
                        dismissed.append(worker)
                        worker.dismiss()
                    if made:
                        yield made
        finally:
            for worker in (*dismissed, *farm.values()):
                worker.end()

    return make
