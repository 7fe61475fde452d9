"""Shards are read as written or refused by name, in memory by the file's size; one builder at a
time holds a folder.
"""

import multiprocessing
import os
import resource
import shutil
import zlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import h5py
import numpy as np
import pytest
from fake_workers import samples_of
from nlos_calibration import load_rig

import nlos_cam
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.shards import (
    check_arrays,
    only_builder,
    read_arrays,
    read_head,
    shard_path,
    shards_of,
    store,
)
from nlos_cam.errors import DiskFullError, OutputExistsError, RecordingError
from nlos_cam.files import read_hdf5

SEEDS = range(40, 43)
PLAN = DatasetPlan(load_rig("paper-rig"), SEEDS.start)
MAX_GROWTH_MIB = 64
"""Memory for a shard of at most 600 kB, with the pages that a forked process writes to."""
TEXT_BYTES = 60_000
ROWS = 4000


def _stored(folder: Path, seeds: range = SEEDS) -> Path:
    path = shard_path(folder, seeds.start)
    store(path, samples_of(seeds), PLAN.provenance, "nlos-cam dataset build")
    return path


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    return _stored(tmp_path)


def _replace(file: h5py.File, name: str, **options: Any) -> h5py.Dataset:
    checksum = file[name].attrs["sha256"]
    del file[name]
    made = file.create_dataset(name, **options)
    made.attrs["sha256"] = checksum
    return made


def _declare(**options: Any) -> Callable[[h5py.File], object]:
    return lambda file: _replace(file, "image", **options)


def _one_chunk(file: h5py.File, content: bytes, mask: int = 0) -> None:
    """Give a chunk of 4 KiB these bytes, packed or (by its mask) plain."""
    shape = (1 << 10,)
    image = _replace(file, "image", shape=shape, dtype="f4", chunks=shape, compression="gzip")
    image.id.write_direct_chunk((0,), content if mask else zlib.compress(content), mask)


def _bomb(file: h5py.File) -> None:
    """Give a chunk of 4 KiB bytes that unpack to 256 MiB."""
    _one_chunk(file, bytes(1 << 28))


def _short_chunk(file: h5py.File, mask: int) -> None:
    _one_chunk(file, bytes(64), mask)


def _one_text_in_all_rows(file: h5py.File) -> None:
    texts = ["x" * TEXT_BYTES, *"y" * (ROWS - 1)]
    rows = _replace(file, "category", data=texts, dtype=h5py.string_dtype()).id
    path = Path(file.filename)
    start = rows.get_offset()
    size = rows.get_storage_size()
    file.close()
    content = bytearray(path.read_bytes())
    content[start : start + size] = (
        content[start : start + size // ROWS] * ROWS
    )  # the address of the first text
    path.write_bytes(content)


def _crafted(file: h5py.File, harm: str) -> None:
    """Change a shard consistently, as no accident does."""
    image = file["image"][:]
    other = shutil.copy(file.filename, Path(file.filename).with_name("other.h5"))
    if harm == "no checksum":
        del file["image"].attrs["sha256"]
        file["image"][:] = 0
    elif harm == "no plan checksum":
        del file.attrs["plan_sha256"]
    elif harm == "plan of two texts":
        file.attrs["plan"] = np.array(["a", "b"], h5py.string_dtype())
    elif harm == "external link":
        del file["image"]
        file["image"] = h5py.ExternalLink("other.h5", "/image")
    elif harm == "soft link":
        file.move("image", "moved")
        file["image"] = h5py.SoftLink("/moved")
    elif harm == "external storage":
        _replace(
            file,
            "image",
            shape=image.shape,
            dtype=image.dtype,
            external=[(str(other), 0, image.nbytes)],
        )
    else:
        layout = h5py.VirtualLayout(image.shape, image.dtype)
        layout[:] = h5py.VirtualSource(str(other), "image", image.shape)
        checksum = file["image"].attrs["sha256"]
        del file["image"]
        file.create_virtual_dataset("image", layout).attrs["sha256"] = checksum


def _without_seeds(file: h5py.File, other: str) -> None:
    del file["seed"]
    if other == "group":
        file.create_group("seed")
    elif other == "type":
        file["seed"] = np.dtype(int)
    else:
        file["seed"] = np.array(["a", "b"], h5py.string_dtype())


CRAFTED = (
    "no checksum",
    "no plan checksum",
    "plan of two texts",
    "external link",
    "soft link",
    "external storage",
)
HARMS = {
    "chunk for each number": _declare(
        shape=(1 << 18,), dtype="f4", chunks=(1,), compression="gzip"
    ),
    "chunks that are absent": _declare(
        shape=(1 << 40,), dtype="f4", chunks=(1 << 20,), compression="gzip"
    ),
    "plain chunks that are absent": _declare(shape=(1 << 24,), dtype="f4", chunks=(1 << 20,)),
    "numbers that are absent": _declare(shape=(1 << 24,), dtype="f4"),
    "chunk beyond the array": _declare(shape=(3,), maxshape=(None,), dtype="f4", chunks=(1 << 28,)),
    "other compression": _declare(data=np.zeros(1 << 24, "i1"), compression="lzf"),
    "texts in chunks": _declare(shape=(3,), dtype="S1000", chunks=(1,)),
    "bomb": _bomb,
    "short packed chunk": partial(_short_chunk, mask=0),
    "short plain chunk": partial(_short_chunk, mask=1),
    "one text in all rows": _one_text_in_all_rows,
    "references": _declare(shape=(3,), dtype=h5py.ref_dtype),
    **{harm: partial(_crafted, harm=harm) for harm in (*CRAFTED, "virtual")},
    **{
        f"{other} instead of seeds": partial(_without_seeds, other=other)
        for other in ("group", "type", "words")
    },
}


def _in_child(act: Callable[[Path], Any], path: Path) -> Any:
    """Act in a process of its own, forked by one without threads, whose locks a fork would keep
    locked.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("forkserver")) as pool:
        return pool.submit(act, path).result()


def _refuse(path: Path) -> int:
    """Refuse a shard; return the memory in MiB that this adds to the process."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RecordingError, match=f"{path.name} is damaged"):
        check_arrays(read_head(path))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before >> 10


@pytest.mark.parametrize("harm", HARMS)
def test_crafted_shard_is_refused_within_little_memory(shard: Path, harm: str) -> None:
    with h5py.File(shard, "a") as file:
        HARMS[harm](file)

    assert shard.stat().st_size < 600_000
    assert _in_child(_refuse, shard) < MAX_GROWTH_MIB


@pytest.mark.parametrize("shape", [(7,), (5, 3, 4), (33, 65)])
@pytest.mark.parametrize("kind", ["f8", ">i2", "u1", "f2"])
@pytest.mark.parametrize("storage", [{}, {"chunks": True}, {"compression": "gzip"}])
def test_read_array_returns_what_was_stored(
    tmp_path: Path, shape: tuple[int, ...], kind: str, storage: dict
) -> None:
    values = np.random.default_rng(1).integers(0, 100, shape).astype(kind)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, **storage)

    with h5py.File(tmp_path / "a.h5") as file:
        found = read_hdf5(file, "a")

    assert found.dtype == values.dtype
    assert found.shape == values.shape
    np.testing.assert_array_equal(found, values)


def test_read_array_returns_texts(tmp_path: Path) -> None:
    texts = ["", "ä", "b\nc"]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["texts"] = texts

    with h5py.File(tmp_path / "a.h5") as file:
        assert read_hdf5(file, "texts").tolist() == texts


def test_lack_of_memory_does_not_count_as_damage(
    shard: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(np, "empty", Mock(side_effect=MemoryError))

    with pytest.raises(MemoryError):
        read_head(shard)


def test_lack_of_permission_names_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = PermissionError(13, "Permission denied", str(tmp_path))
    monkeypatch.setattr(Path, "mkdir", Mock(side_effect=refusal))

    with pytest.raises(OutputExistsError, match=str(tmp_path)), only_builder(tmp_path):
        pass


def _assert_as_stored(path: Path) -> None:
    head = read_head(path)
    samples = samples_of(SEEDS)
    assert (head.seeds, head.plan) == (SEEDS, PLAN)
    for values, found in zip(samples.values(), read_arrays(head, list(samples)), strict=True):
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


def test_shard_is_read_as_stored(shard: Path) -> None:
    _assert_as_stored(shard)
    check_arrays(read_head(shard))


def test_shard_is_named_by_its_first_seed(shard: Path) -> None:
    assert [path.name for path in shard.parent.iterdir()] == ["shard-000000040.h5"]


def test_shard_describes_itself(shard: Path) -> None:
    with h5py.File(shard) as file:
        facts = dict(file.attrs)

    assert facts["first_seed"] == 40
    assert facts["last_seed"] == 42
    assert facts["package_version"] == nlos_cam.__version__
    assert facts["command"] == "nlos-cam dataset build"
    assert PLAN.rig.checksum in facts["plan"]


def test_shard_with_flipped_bit_is_damaged_or_unchanged(shard: Path) -> None:
    """A flip in padding or in a time stamp changes nothing that is read; any other flip is an
    error.
    """
    whole = shard.read_bytes()
    refusals = list[str]()

    for place in np.random.default_rng(0).integers(0, len(whole), 100):
        harmed = bytearray(whole)
        harmed[place] ^= 1 << int(place) % 8
        shard.write_bytes(harmed)
        try:
            check_arrays(read_head(shard))
        except RecordingError as error:
            refusals.append(str(error))
        else:
            _assert_as_stored(shard)

    assert len(refusals) > 15
    assert all(refusal.startswith(f"{shard} is damaged") for refusal in refusals)


def test_shards_of_refuses_overlapping_shards(shard: Path) -> None:
    _stored(shard.parent, range(42, 44))

    with pytest.raises(RecordingError, match=r"shard-000000042\.h5.*shard-000000040\.h5"):
        shards_of(shard.parent)


def test_shards_of_refuses_renamed_shard(shard: Path) -> None:
    other = _stored(shard.parent, range(43, 45))
    other.rename(shard_path(shard.parent, 50))

    with pytest.raises(RecordingError, match=r"shard-000000050\.h5"):
        shards_of(shard.parent)


def _fill_disk(folder: Path) -> None:
    """Store where files may not grow: in another process, since our own output may be a file."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
    with pytest.raises(DiskFullError, match=r"shard-000000040\.h5"):
        _stored(folder)


def _interrupt(folder: Path) -> None:
    """Store where Ctrl+C comes before the file is safe."""
    with (
        patch.object(os, "fsync", side_effect=KeyboardInterrupt),
        pytest.raises(KeyboardInterrupt),
    ):
        _stored(folder)


@pytest.mark.parametrize("fail", [partial(_in_child, _fill_disk), _interrupt])
def test_failed_store_keeps_the_earlier_shard_alone(
    shard: Path, fail: Callable[[Path], None]
) -> None:
    before = shard.read_bytes()

    fail(shard.parent)

    assert shard.read_bytes() == before
    assert list(shard.parent.iterdir()) == [shard]
