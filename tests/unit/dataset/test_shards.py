"""Dataset shards are read as written or refused by name; one builder at a time holds a folder."""

import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_farm import samples_of
from filelock import FileLock
from nlos_calibration.rig import load_rig

import nlos_cam
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.shards import (
    LOCK,
    NOTE,
    check_arrays,
    only_builder,
    read_arrays,
    read_head,
    shard_path,
    shards_of,
    store,
)
from nlos_cam.errors import DiskFullError, FolderBusyError, OutputExistsError, RecordingError

PLAN = DatasetPlan(load_rig("paper-rig"), 40)
SEEDS = range(40, 43)
HOLD = """
import sys
from filelock import FileLock
lock = FileLock(sys.argv[1])
lock.acquire()
print("held", flush=True)
input()
"""


def _stored(folder: Path, seeds: range = SEEDS) -> Path:
    path = shard_path(folder, seeds.start)
    store(path, samples_of(seeds), PLAN.provenance, "nlos-cam dataset build")
    return path


def _is_damaged(path: Path) -> bool:
    try:
        check_arrays(read_head(path))
    except RecordingError as error:
        return str(error).startswith(f"{path} is damaged")
    return False


def _assert_as_stored(path: Path) -> None:
    head, samples = read_head(path), samples_of(SEEDS)
    assert (head.seeds, head.plan) == (SEEDS, PLAN)
    for values, found in zip(samples.values(), read_arrays(head, list(samples)), strict=True):
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


def test_shard_is_read_as_stored_and_describes_itself(tmp_path: Path) -> None:
    _assert_as_stored(path := _stored(tmp_path))
    check_arrays(read_head(path))
    assert [path.name for path in tmp_path.iterdir()] == ["shard-000000040.h5"]
    with h5py.File(path) as file:
        facts = dict(file.attrs)
    assert (facts["first_seed"], facts["last_seed"]) == (40, 42)
    assert (facts["package_version"], facts["command"]) == (nlos_cam.__version__, "nlos-cam dataset build")
    assert PLAN.rig.checksum in facts["plan"]


def test_shard_with_flipped_bit_is_damaged_or_unchanged(tmp_path: Path) -> None:
    """A flip in padding or in a time stamp changes nothing that is read; any other flip is an error."""
    path = _stored(tmp_path)
    whole, damaged = path.read_bytes(), 0
    for place in np.random.default_rng(0).integers(0, len(whole), 100):
        harmed = bytearray(whole)
        harmed[place] ^= 1 << int(place) % 8
        path.write_bytes(harmed)
        if _is_damaged(path):
            damaged += 1
        else:
            _assert_as_stored(path)
    assert damaged > 15


@pytest.mark.parametrize("other", ["group", "type", "words"])
def test_shard_without_array_of_seeds_is_damaged(tmp_path: Path, other: str) -> None:
    path = _stored(tmp_path)
    with h5py.File(path, "a") as file:
        del file["seed"]
        if other == "group":
            file.create_group("seed")
        else:
            file["seed"] = np.dtype(int) if other == "type" else np.array(["a", "b"], h5py.string_dtype())
    assert _is_damaged(path)


def test_shards_of_refuses_overlapping_and_renamed_shards(tmp_path: Path) -> None:
    _stored(tmp_path)
    other = _stored(tmp_path, range(42, 44))
    with pytest.raises(RecordingError, match=r"shard-000000042\.h5.*shard-000000040\.h5"):
        shards_of(tmp_path)
    other.rename(shard_path(tmp_path, 50))
    with pytest.raises(RecordingError, match=r"shard-000000050\.h5"):
        shards_of(tmp_path)


def test_shard_without_checksums_of_older_version_is_read(tmp_path: Path) -> None:
    path = _stored(tmp_path)
    with h5py.File(path, "a") as file:
        for name in ("plan_sha256", "command", "package_version", "first_seed", "last_seed"):
            del file.attrs[name]
        del file["scene"]
        for stored in file.values():
            del stored.attrs["sha256"]
    check_arrays(head := read_head(path))
    np.testing.assert_array_equal(read_arrays(head, ["image"])[0], samples_of(SEEDS)["image"])


def test_store_leaves_no_partial_file_after_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _stored(tmp_path)
    assert list(tmp_path.iterdir()) == []


def _store_on_full_disk(folder: Path) -> int:
    """Store in a child process whose files may not grow, since our own output may be a file; 0 for DiskFullError."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
            _stored(folder)
        except DiskFullError as error:
            code = 0 if re.search(r"shard-000000040\.h5", str(error)) else 2
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_store_keeps_earlier_shard_when_disk_is_full(tmp_path: Path) -> None:
    path = _stored(tmp_path)
    before = path.read_bytes()
    assert _store_on_full_disk(tmp_path) == 0
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_lock_is_held_once_and_names_its_holder(tmp_path: Path) -> None:
    with only_builder(tmp_path):
        with pytest.raises(FolderBusyError, match=str(os.getpid())):
            only_builder(tmp_path).__enter__()
        assert str(os.getpid()) in (tmp_path / NOTE).read_text(encoding="utf-8")
    assert not (tmp_path / NOTE).exists()
    with pytest.raises(ZeroDivisionError), only_builder(tmp_path):
        raise ZeroDivisionError
    with only_builder(tmp_path):  # free again after an error
        pass


def test_lock_of_killed_process_is_free(tmp_path: Path) -> None:
    (tmp_path / NOTE).write_text("process 1 on elsewhere", encoding="utf-8")
    command = [sys.executable, "-c", HOLD, str(tmp_path / LOCK)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(FolderBusyError, match="process 1 on elsewhere"), only_builder(tmp_path):
            pass
        holder.kill()
    with only_builder(tmp_path):
        assert str(os.getpid()) in (tmp_path / NOTE).read_text(encoding="utf-8")


def test_lock_refuses_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: FileLock, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path / LOCK))

    monkeypatch.setattr(FileLock, "acquire", refused)
    with pytest.raises(OutputExistsError, match=str(tmp_path)), only_builder(tmp_path):
        pass
