"""Dataset shards are read as written or refused by name; one builder at a time holds a folder."""

import os
import re
import resource
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fake_farm import samples_of
from nlos_calibration.rig import load_rig

import nlos_cam
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.shards import check_arrays, only_builder, read_arrays, read_head, shard_path, shards_of, store
from nlos_cam.errors import DiskFullError, OutputExistsError, RecordingError

PLAN = DatasetPlan(load_rig("paper-rig"), 40)
SEEDS = range(40, 43)


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


def _replace(file: h5py.File, name: str, **options: Any) -> None:
    checksum = file[name].attrs["sha256"]
    del file[name]
    file.create_dataset(name, **options).attrs["sha256"] = checksum


def _crafted(path: Path, harm: str) -> None:
    """Change a shard consistently, as no accident does."""
    other = path.with_name("other.h5")
    shutil.copyfile(path, other)
    with h5py.File(path, "a") as file:
        image = file["image"][:]
        if harm == "no checksum":
            del file["image"].attrs["sha256"]
            file["image"][:] = 0
        elif harm == "no plan checksum":
            del file.attrs["plan_sha256"]
        elif harm == "external link":
            del file["image"]
            file["image"] = h5py.ExternalLink(other.name, "/image")
        elif harm == "soft link":
            file.move("image", "moved")
            file["image"] = h5py.SoftLink("/moved")
        elif harm == "external storage":
            _replace(file, "image", shape=image.shape, dtype=image.dtype, external=[(str(other), 0, image.nbytes)])
        elif harm == "virtual":
            layout = h5py.VirtualLayout(image.shape, image.dtype)
            layout[:] = h5py.VirtualSource(str(other), "image", image.shape)
            checksum = file["image"].attrs["sha256"]
            del file["image"]
            file.create_virtual_dataset("image", layout).attrs["sha256"] = checksum
        else:
            _replace(file, "image", shape=(3,), dtype=h5py.ref_dtype)


HARMS = "no checksum", "no plan checksum", "external link", "soft link", "external storage", "virtual", "refs"


@pytest.mark.parametrize("harm", HARMS)
def test_crafted_shard_is_refused(tmp_path: Path, harm: str) -> None:
    path = _stored(tmp_path)
    _crafted(path, harm)
    assert _is_damaged(path)


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


def test_lock_refuses_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(OutputExistsError, match=str(tmp_path)), only_builder(tmp_path):
        pass
