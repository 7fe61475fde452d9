"""Shards whose declared sizes exceed the bytes they hold are refused, and refusing takes memory by the file's size."""

import os
import resource
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fake_farm import samples_of
from nlos_calibration import load_rig

from nlos_cam.dataset import DatasetPlan, check_arrays, read_head
from nlos_cam.dataset.hdf5 import read_array
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import RecordingError

SEEDS = range(40, 43)
PLAN = DatasetPlan(load_rig("paper-rig"), SEEDS.start)
MAX_GROWTH_MIB = 64
"""Memory for a shard of at most 600 kB, with the pages that a forked process writes to."""
TEXT_BYTES, ROWS = 60_000, 4000


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    store(path := shard_path(tmp_path, SEEDS.start), samples_of(SEEDS), PLAN.provenance, "")
    return path


def _replace(file: h5py.File, name: str, **options: Any) -> h5py.Dataset:
    checksum = file[name].attrs["sha256"]
    del file[name]
    made = file.create_dataset(name, **options)
    made.attrs["sha256"] = checksum
    return made


def _declare(**options: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            _replace(file, "image", **options)

    return change


def _bomb(path: Path) -> None:
    """Give a chunk of 4 KiB bytes that unpack to 256 MiB."""
    with h5py.File(path, "a") as file:
        image = _replace(file, "image", shape=(1 << 10,), dtype="f4", chunks=(1 << 10,), compression="gzip")
        image.id.write_direct_chunk((0,), zlib.compress(bytes(1 << 28)))


def _one_text_in_all_rows(path: Path) -> None:
    with h5py.File(path, "a") as file:
        texts = ["x" * TEXT_BYTES, *"y" * (ROWS - 1)]
        rows = _replace(file, "category", data=texts, dtype=h5py.string_dtype()).id
        start, size = rows.get_offset(), rows.get_storage_size()
    content = bytearray(path.read_bytes())
    content[start : start + size] = content[start : start + size // ROWS] * ROWS  # the address of the first text
    path.write_bytes(content)


def _plan_of_two_texts(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["plan"] = np.array(["a", "b"], h5py.string_dtype())


HARMS = {
    "chunk for each number": _declare(shape=(1 << 18,), dtype="f4", chunks=(1,), compression="gzip"),
    "chunks that are absent": _declare(shape=(1 << 40,), dtype="f4", chunks=(1 << 20,), compression="gzip"),
    "plain chunks that are absent": _declare(shape=(1 << 24,), dtype="f4", chunks=(1 << 20,)),
    "numbers that are absent": _declare(shape=(1 << 24,), dtype="f4"),
    "chunk beyond the array": _declare(shape=(3,), maxshape=(None,), dtype="f4", chunks=(1 << 28,)),
    "other compression": _declare(data=np.zeros(1 << 24, "i1"), compression="lzf"),
    "texts in chunks": _declare(shape=(3,), dtype="S1000", chunks=(1,)),
    "bomb": _bomb,
    "one text in all rows": _one_text_in_all_rows,
    "plan of two texts": _plan_of_two_texts,
}


def _growth_mib(act: Callable[[], object]) -> int:
    """Return the memory that an action adds to a forked process; fail where it raises."""
    read_end, write_end = os.pipe()
    if (child := os.fork()) == 0:
        try:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            act()
            os.write(write_end, str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before >> 10).encode())
        finally:
            os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end) as answer:
        grown = answer.read()
    os.waitpid(child, 0)
    assert grown, "the action failed"
    return int(grown)


def _refuse(path: Path) -> None:
    with pytest.raises(RecordingError, match=f"{path.name} is damaged"):
        check_arrays(read_head(path))


@pytest.mark.parametrize("harm", HARMS)
def test_shard_with_false_sizes_is_refused_within_little_memory(shard: Path, harm: str) -> None:
    HARMS[harm](shard)
    assert shard.stat().st_size < 600_000
    assert _growth_mib(lambda: _refuse(shard)) < MAX_GROWTH_MIB


@pytest.mark.parametrize("shape", [(7,), (5, 3, 4), (33, 65)])
@pytest.mark.parametrize("kind", ["f8", ">i2", "u1", "f2"])
@pytest.mark.parametrize("storage", [{}, {"chunks": True}, {"compression": "gzip"}])
def test_read_array_returns_what_was_stored(
    tmp_path: Path, shape: tuple[int, ...], kind: str, storage: dict[str, Any]
) -> None:
    values = np.random.default_rng(1).integers(0, 100, shape).astype(kind)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, **storage)
        file["texts"] = ["", "ä", "b\nc"]
    with h5py.File(tmp_path / "a.h5") as file:
        found = read_array(file, "a")
        assert (found.dtype, found.shape) == (values.dtype, values.shape)
        np.testing.assert_array_equal(found, values)
        assert read_array(file, "texts").tolist() == ["", "ä", "b\nc"]


def test_lack_of_memory_does_not_count_as_damage(shard: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lack(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(np, "empty", lack)
    with pytest.raises(MemoryError):
        read_head(shard)
