"""Shards: what is written is what is read, or an error that names the shard; a full disk costs nothing."""

import os
import re
import resource
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_farm import samples_of
from nlos_calibration.rig import load_rig

import nlos_cam
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.shards import check_all, head_of, read_arrays, shard_path, shards_of, store
from nlos_cam.errors import DiskFullError, RecordingError

PLAN = DatasetPlan(load_rig("paper-rig"), 40)
SEEDS = range(40, 43)


def _stored(folder: Path, seeds: range = SEEDS) -> Path:
    path = shard_path(folder, seeds.start)
    store(path, samples_of(seeds), PLAN.provenance, "nlos-cam dataset build")
    return path


def _is_damaged(path: Path) -> bool:
    try:
        check_all(head_of(path))
    except RecordingError as error:
        return str(error).startswith(f"{path} is damaged")
    return False


def test_what_is_written_is_read(tmp_path: Path) -> None:
    head, samples = head_of(_stored(tmp_path)), samples_of(SEEDS)
    assert (head.seeds, head.plan) == (SEEDS, PLAN)
    for values, found in zip(samples.values(), read_arrays(head, list(samples)), strict=True):
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)
    check_all(head)
    assert [path.name for path in tmp_path.iterdir()] == ["shard-000000040.h5"]


def test_a_shard_says_where_it_is_from(tmp_path: Path) -> None:
    with h5py.File(_stored(tmp_path)) as file:
        facts = dict(file.attrs)
    assert (facts["first_seed"], facts["last_seed"]) == (40, 42)
    assert facts["package_version"] == nlos_cam.__version__
    assert facts["command"] == "nlos-cam dataset build"
    assert PLAN.rig.checksum in facts["plan"]


def test_the_same_samples_are_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    assert _stored(tmp_path).read_bytes() == _stored(tmp_path / "other").read_bytes()


def test_no_flipped_bit_is_read_as_data(tmp_path: Path) -> None:
    """A flip either changes nothing that is read (padding, a time) or is an error; wherever it is."""
    path = _stored(tmp_path)
    whole, samples, found = path.read_bytes(), samples_of(SEEDS), 0
    for place in np.random.default_rng(0).integers(0, len(whole), 100):
        harmed = bytearray(whole)
        harmed[place] ^= 1 << int(place) % 8
        path.write_bytes(harmed)
        if _is_damaged(path):
            found += 1
            continue
        head = head_of(path)
        assert (head.seeds, head.plan) == (SEEDS, PLAN)
        for values, read in zip(samples.values(), read_arrays(head, list(samples)), strict=True):
            np.testing.assert_array_equal(read, values)
    assert found > 15


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_shard_cut_short_is_damaged(tmp_path: Path, share: float) -> None:
    path = _stored(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(RecordingError, match=r"shard-000000040\.h5 is damaged .*build again"):
        check_all(head_of(path))


def test_a_shard_under_another_name_is_damaged(tmp_path: Path) -> None:
    path = _stored(tmp_path)
    path.rename(shard_path(tmp_path, 50))
    with pytest.raises(RecordingError, match="not those of its name"):
        shards_of(tmp_path)


@pytest.mark.parametrize("other", ["group", "type", "words"])
def test_what_is_no_array_of_seeds_is_damage(tmp_path: Path, other: str) -> None:
    path = _stored(tmp_path)
    with h5py.File(path, "a") as file:
        del file["seed"]
        if other == "group":
            file.create_group("seed")
        else:
            file["seed"] = np.dtype(int) if other == "type" else np.array(["a", "b"], h5py.string_dtype())
    assert _is_damaged(path)


def test_ctrl_c_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _stored(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_shards_that_hold_the_same_objects_are_refused(tmp_path: Path) -> None:
    _stored(tmp_path)
    _stored(tmp_path, range(42, 44))
    with pytest.raises(RecordingError, match=r"shard-000000042\.h5 holds objects that shard-000000040\.h5 holds too"):
        shards_of(tmp_path)


def test_shards_from_before_the_checksums_are_read(tmp_path: Path) -> None:
    path = _stored(tmp_path)
    with h5py.File(path, "a") as file:
        for name in ("plan_sha256", "command", "package_version", "first_seed", "last_seed"):
            del file.attrs[name]
        del file["scene"]
        for stored in file.values():
            del stored.attrs["sha256"]
    head = head_of(path)
    check_all(head)
    np.testing.assert_array_equal(read_arrays(head, ["image"])[0], samples_of(SEEDS)["image"])


def _refused_by_a_limit_on_files(folder: Path) -> int:
    """Store in a child whose files may not grow: 0 if that is told as a full disk. Our own output may be a file."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
            _stored(folder)
        except DiskFullError as error:
            code = 0 if re.search(r"shard-000000040\.h5 .*make room and build again", str(error)) else 2
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_full_disk_keeps_the_shard_that_was_there(tmp_path: Path) -> None:
    path = _stored(tmp_path)
    before = path.read_bytes()
    assert _refused_by_a_limit_on_files(tmp_path) == 0
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
