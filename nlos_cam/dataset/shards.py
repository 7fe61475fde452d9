"""Shards of a dataset: HDF5 files of samples with their plan and checksums of all arrays, and the
lock of a builder.
"""

import errno
import hashlib
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nlos_cam import __version__
from nlos_cam.dataset.plan import SCENE_COLUMNS, DatasetPlan
from nlos_cam.dataset.samples import Samples
from nlos_cam.errors import DiskFullError, FolderBusyError, OutputExistsError, RecordingError
from nlos_cam.files import (
    FileBusyError,
    atomic_file,
    claim,
    describe,
    program_commit,
    read_hdf5,
    read_hdf5_text,
    with_commit,
)

SHARD_PATTERN = "shard-*.h5"
REQUIRED_ARRAYS = ("depth_m", "intensity", "image", "object_depth_m", "seed", "category", "scene")
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""No space left, a quota reached, or a limit on the size of files."""


@dataclass(frozen=True)
class Shard:
    """Head of a shard."""

    path: Path
    seeds: range
    provenance: str
    """Its plan, as JSON."""

    @property
    def plan(self) -> DatasetPlan:
        """The plan. Raises RecordingError where this nlos-cam cannot read it."""
        try:
            return DatasetPlan.from_provenance(self.provenance)
        except ValueError as error:
            problem = " ".join(str(error).split())
            raise RecordingError(
                f"{self.path} has a plan that cannot be read: {problem:.200}"
            ) from error


def shard_path(folder: Path, first_seed: int) -> Path:
    """Return the path of the shard that begins with a seed; names sort in the order of seeds."""
    return folder / f"shard-{first_seed:09d}.h5"


def shards_of(folder: Path) -> list[Shard]:
    """Return the heads of a folder's shards, in the order of their seeds. Raises RecordingError for
    a damaged one.
    """
    heads = sorted(
        (read_head(path) for path in folder.glob(SHARD_PATTERN)), key=lambda head: head.seeds.start
    )
    for one, following in pairwise(heads):
        if following.seeds.start < one.seeds.stop:
            raise RecordingError(
                f"{following.path} and {one.path.name} hold the same objects: they belong to two"
                " datasets; delete one"
            )
    return heads


def read_head(path: Path) -> Shard:
    """Return the head of a shard. Raises RecordingError where it cannot be read."""
    with open_shard(path) as file:
        plan = read_hdf5_text(file, "plan")
        seeds = _checked(path, "seed", file)
        if read_hdf5_text(file, "plan_sha256", "") != _digest(plan.encode()):
            raise _damaged(path, "the checksum of its plan is missing or differs")
        consecutive = seeds.ndim == 1 and len(seeds) and (np.diff(seeds) == 1).all()
        if not consecutive or shard_path(path.parent, seeds[0]) != path:
            raise _damaged(path, "its seeds do not match its name, or are not consecutive")
        return Shard(path, range(int(seeds[0]), int(seeds[-1]) + 1), plan)


def shard_origin(path: Path) -> tuple[str, str]:
    """Return the version of nlos-cam, with its commit, and the command that made a shard; "unknown"
    as far as it does not say.
    """
    with open_shard(path) as file:
        version = read_hdf5_text(file, "package_version", "unknown")
        commit = read_hdf5_text(file, "commit", "")
        command = read_hdf5_text(file, "command", "unknown")
    return with_commit(version, commit), command


def read_arrays(head: Shard, names: Sequence[str]) -> list[NDArray[Any]]:
    """Return arrays of the objects of a head. The shard may have more, where its dataset was
    extended since the head was read, or is not used whole.

    Raises RecordingError where an array differs from its checksum.
    """
    count = len(head.seeds)
    with open_shard(head.path) as file:
        found = [_checked(head.path, name, file) for name in names]
        rows = max(count, len(_checked(head.path, "seed", file)))
    for name, values in zip(names, found, strict=True):
        if len(values) != rows:
            raise _damaged(head.path, f"{name} has {len(values)} rows for {rows} objects")
    return [values[:count] for values in found]


def check_arrays(head: Shard) -> None:
    """Read all arrays. Raises RecordingError where the shard is damaged."""
    names = {*array_names(head), *REQUIRED_ARRAYS}
    read_arrays(head, sorted(names))


def array_names(head: Shard) -> set[str]:
    """Return the names of a shard's arrays. Raises RecordingError where it cannot be read."""
    with open_shard(head.path) as file:
        return set(map(str, file))


def store(path: Path, samples: Samples, provenance: str, command: str) -> None:
    """Write a shard beside its place, and rename it when it is on the disk.

    Raises DiskFullError where it does not fit; what was there stays.
    """
    try:
        with atomic_file(path) as part:
            part.write_bytes(_as_bytes(samples, provenance, command))
    except OSError as error:
        if error.errno in NO_ROOM:
            raise DiskFullError(
                f"no room for {path} ({error.strerror}): what was made so far is kept; make room"
                " and build again"
            ) from error
        raise


def _as_bytes(samples: Samples, provenance: str, command: str) -> bytes:
    memory = BytesIO()
    with h5py.File(memory, "w") as file:
        seeds = samples["seed"]
        file.attrs.update({"plan": provenance, "plan_sha256": _digest(provenance.encode())})
        # a path may hold bytes that are no text, which HDF5 does not store
        file.attrs["command"] = command.encode("utf-8", "backslashreplace").decode()
        file.attrs["package_version"] = __version__
        file.attrs["commit"] = program_commit()
        file.attrs.update({"first_seed": int(seeds[0]), "last_seed": int(seeds[-1])})
        for name, values in samples.items():
            if values.dtype == object:
                stored = file.create_dataset(name, data=values, dtype=h5py.string_dtype())
            else:
                stored = file.create_dataset(
                    name, data=values, compression="gzip", compression_opts=1
                )
            stored.attrs["sha256"] = content_checksum(values)
        file["scene"].attrs["columns"] = SCENE_COLUMNS
    return memory.getvalue()


def content_checksum(values: NDArray[Any]) -> str:
    """Return the SHA-256 of an array's type, shape and values."""
    kind = f"{values.dtype.str} {values.shape} ".encode()
    content = (
        "\0".join(values).encode()
        if values.dtype == object
        else np.ascontiguousarray(values).tobytes()
    )
    return _digest(kind + content)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@contextmanager
def open_shard(path: Path) -> Generator[h5py.File]:
    """Open a shard. Raises RecordingError where it cannot be read, also within the block."""
    try:
        with h5py.File(path) as file:
            yield file
    except (RecordingError, MemoryError):
        raise
    except Exception as error:  # h5py raises almost anything for damage
        raise _damaged(path, f"cannot be read as a shard: {describe(error)}") from error


def _checked(path: Path, name: str, file: h5py.File) -> NDArray[Any]:
    """Return an array of a shard whose checksum, size and storage have been verified."""
    try:
        values = read_hdf5(file, name)
    except ValueError as error:
        raise _damaged(path, describe(error)) from error
    if read_hdf5_text(file[name], "sha256", "") != content_checksum(values):
        raise _damaged(path, f"the checksum of {name} is missing or differs")
    return values


def _damaged(path: Path, why: str) -> RecordingError:
    return RecordingError(f"{path} is damaged ({why}): build again to replace it, or delete it")


@contextmanager
def only_builder(folder: Path) -> Generator[None]:
    """Hold the right to build in a folder, which the system releases when its holder dies.

    Raises FolderBusyError, with the holder's process id, where another process has it, and
    OutputExistsError where the folder cannot be written to.
    """
    try:
        with claim(folder, inside=True):
            yield
    except FileBusyError as error:
        raise FolderBusyError(str(error)) from error
    except PermissionError as error:
        raise OutputExistsError(
            f"{folder} cannot be written to: choose another --out, or change its permissions"
        ) from error
