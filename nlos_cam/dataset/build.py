"""Objects and renderer to HDF5 shards of lidar maps and hidden images, resumable at any moment.

Workers make samples, one process writes them: a shard is written beside its place and renamed when whole, and building
again makes only what is missing or damaged. A sample depends on its seed alone, so any workers make the same shards.

How a worker process begins: with one thread, deaf to Ctrl-C, and set to end with its parent.
"""

import os
import signal
import time
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread

from nlos_models import MapSet

from nlos_cam.dataset.plan import DatasetPlan, Objects, RigSpread
from nlos_cam.dataset.reader import MAP_CHANNELS, Dataset, open_dataset, read
from nlos_cam.dataset.samples import Samples, joined, make_samples, objects_of, procedural_images, sense_object, silent
from nlos_cam.dataset.shards import PARTS, SHARDS, Shard, check_all, head_of, only_builder, shard_path, store
from nlos_cam.errors import OutputExistsError, RecordingError, WorkersLostError


def begin_worker() -> None:
    """Make this process a worker; what it prepares lasts as long as it does."""
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"  # numpy is still to be imported
    one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends its workers
    Thread(target=end_with_parent, daemon=True).start()


def one_thread() -> None:
    """One object per process is faster than several threads per object."""
    import numba

    numba.set_num_threads(1)


def end_with_parent() -> None:
    """Wait for the parent's end, and end: one that is killed tells nobody, and its workers would wait for ever."""
    if parent := parent_process():
        parent.join()
        os._exit(1)


__all__ = [
    "MAP_CHANNELS",
    "Built",
    "Dataset",
    "DatasetPlan",
    "MapSet",
    "Objects",
    "RigSpread",
    "build_dataset",
    "objects_of",
    "open_dataset",
    "procedural_images",
    "read",
    "sense_object",
]

TRAINING_SEED, HELD_OUT_SEED, TEST_SEED = 0, 10_000_000, 20_000_000
"""Objects that judge come from seeds that no training run reaches."""
SHARD = 100
"""Objects in a shard: what a kill can cost of each that is being made."""
PIECE = 10
"""Objects that a worker makes at a time: so far apart do workers end."""

OnProgress = Callable[[int, int], None]
Made = Generator[tuple[range, Samples]]
Farm = Callable[[DatasetPlan, Sequence[range]], Made]
"""Makes the samples of ranges of seeds, and yields them in any order; closing it ends its workers."""


@dataclass(frozen=True)
class Built:
    """What a build did."""

    objects: int
    """In the folder, of those asked for."""
    made: int
    """Of them, in this run."""
    seconds: float
    damaged: tuple[Path, ...]
    """Shards that were made anew because their content was not what was written."""


def build_dataset(
    plan: DatasetPlan,
    count: int,
    folder: Path,
    *,
    workers: int,
    on_progress: OnProgress,
    on_check: OnProgress = silent,
    tell: Callable[[str], None] = silent,
    command: str = "",
    farm: Farm | None = None,
) -> Built:
    """Bring a folder up to `count` objects, by processes of this machine or by another `farm`.

    Raises RecordingError where it holds another plan's shards, FolderBusyError where another build is at it, and
    DiskFullError and WorkersLostError with all finished shards kept.
    """
    plan.check()
    _make_folder(folder)
    with only_builder(folder):
        for part in folder.glob(PARTS):  # of a build that was killed: this one is the only one
            part.unlink()
        wanted = [*_split(range(plan.first_seed, plan.first_seed + count), SHARD)]
        damaged = _survey(folder, plan, on_check)
        missing = [seeds for seeds in wanted if not _holds(folder, seeds, damaged)]
        anew = damaged.keys() & {shard_path(folder, seeds.start) for seeds in missing}
        for path, problem in damaged.items():
            tell(f"{path} is damaged: it is made anew" if path in anew else problem)
        started = time.perf_counter()
        done = count - (made := sum(map(len, missing)))
        on_progress(done, count)
        pieces = [piece for seeds in missing for piece in _split(seeds, PIECE)]
        with closing((farm or processes(workers))(plan, pieces)) as samples:
            for seeds in _stored(folder, plan.provenance, missing, samples, command):
                done += len(seeds)
                on_progress(done, count)
    return Built(count, made, time.perf_counter() - started, tuple(sorted(anew)))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputExistsError(
            f"no folder can be made at {folder} ({error.strerror}): choose another --out"
        ) from error


def _split(seeds: range, size: int) -> Iterator[range]:
    for start in range(seeds.start, seeds.stop, size):
        yield range(start, min(start + size, seeds.stop))


def _survey(folder: Path, plan: DatasetPlan, on_check: OnProgress) -> dict[Path, str]:
    """Shards whose content is not what was written, and why. Raises RecordingError for those of another plan."""
    paths, damaged = sorted(folder.glob(SHARDS)), dict[Path, str]()
    for number, path in enumerate(paths, 1):
        try:
            head = head_of(path)
            check_all(head)
        except RecordingError as error:
            damaged[path] = str(error)
        else:
            _check_same(head, plan)
        on_check(number, len(paths))
    return damaged


def _check_same(head: Shard, plan: DatasetPlan) -> None:
    if others := head.plan.differences(plan):
        raise RecordingError(f"{head.path} is of a dataset with another {', '.join(others)}: choose another --out")
    if (head.seeds.start - plan.first_seed) % SHARD or len(head.seeds) > SHARD:
        raise RecordingError(f"{head.path} holds {len(head.seeds)} objects, not up to {SHARD}: choose another --out")


def _holds(folder: Path, seeds: range, damaged: Container[Path]) -> bool:
    """Whether a shard is there with all of these objects: the last one of a smaller dataset has too few."""
    path = shard_path(folder, seeds.start)
    return path.exists() and path not in damaged and len(head_of(path).seeds) >= len(seeds)


def _stored(folder: Path, provenance: str, missing: Iterable[range], made: Made, command: str) -> Iterator[range]:
    """Store every shard as soon as its last piece is there; yields each piece as it comes."""
    shard_of = {seed: seeds for seeds in missing for seed in seeds[::PIECE]}
    waiting: dict[range, dict[int, Samples]] = {}
    for piece, samples in made:
        seeds = shard_of[piece.start]
        parts = waiting.setdefault(seeds, {})
        parts[piece.start] = samples
        if sum(len(part["seed"]) for part in parts.values()) == len(seeds):
            whole = joined([parts[start] for start in sorted(parts)])
            store(shard_path(folder, seeds.start), whole, provenance, command)
            del waiting[seeds]
        yield piece


def processes(workers: int) -> Farm:
    """A farm of processes on this machine. One that dies is replaced, unless no piece was made since the last did."""

    def made(plan: DatasetPlan, pieces: Sequence[range]) -> Made:
        left = dict.fromkeys(pieces)
        while left:
            before = len(left)
            try:
                for piece, samples in _in_pool(plan, [*left], min(workers, len(left))):
                    del left[piece]
                    yield piece, samples
            except BrokenProcessPool as error:
                if len(left) == before:
                    raise WorkersLostError(
                        f"a worker process was killed (out of memory?) before it made {PIECE} objects: finished shards "
                        "are kept; make room in memory or give fewer --workers, and build again"
                    ) from error

    return made


def _in_pool(plan: DatasetPlan, pieces: Sequence[range], workers: int) -> Made:
    others, broken = set(active_children()), None
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=begin_worker) as pool:
        futures = {pool.submit(make_samples, plan, piece): piece for piece in pieces}
        try:
            for future in as_completed(futures):
                piece, error = futures.pop(future), future.exception()
                if isinstance(error, BrokenProcessPool):
                    broken = error  # of those that were made before, some are still to come
                else:
                    yield piece, future.result()
        except BaseException:
            for child in set(active_children()) - others:  # what they have begun would take seconds
                child.terminate()
            raise
    if broken:
        raise broken
