"""Dataset reader: equal samples in memory and streamed; an epoch depends on seed and epoch
alone.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from fake_workers import samples_of
from nlos_calibration import load_rig
from nlos_models.training import MapBatch, MapSet

from nlos_cam.dataset import DatasetPlan, reader
from nlos_cam.dataset.locked import LOCKED
from nlos_cam.dataset.reader import MAP_CHANNELS, Dataset, _Window, open_dataset
from nlos_cam.dataset.shards import shard_origin, shard_path, store
from nlos_cam.errors import RecordingError

PLAN = DatasetPlan(load_rig("paper-rig"), 40)
COUNT = 43
SHARD = 5


@pytest.fixture(autouse=True)
def _small_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "BUFFER", 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    for start in range(40, 40 + COUNT, SHARD):
        seeds = range(start, min(start + SHARD, 40 + COUNT))
        store(shard_path(folder, start), samples_of(seeds), PLAN.provenance, "")
    return folder


@pytest.fixture
def data(folder: Path) -> Dataset:
    return open_dataset(folder)


def _rows(data: Dataset, seed: int = 0, epoch: int = 0, batch: int = 4) -> list[list[int]]:
    return [found.row.tolist() for found in data.batches(seed, epoch, batch)]


def _every_row(data: Dataset, batch: int = 1) -> list[int]:
    return [row for some in _rows(data, batch=batch) for row in some]


def _assert_as_stored(found: MapBatch) -> None:
    samples = samples_of([40 + row for row in found.row.tolist()])
    for k, mirrored in enumerate(found.mirrored.tolist()):
        turn = slice(None, None, -1 if mirrored else 1)
        np.testing.assert_array_equal(found.depth_m[k], samples["depth_m"][k][turn])
        np.testing.assert_array_equal(found.intensity[k], samples["intensity"][k][turn])
        np.testing.assert_array_equal(
            found.image[k, 0], samples["image"][k][turn].astype(np.float32)
        )


def test_dataset_has_its_samples_and_plan(data: Dataset) -> None:
    assert len(data) == COUNT
    assert data.plan == PLAN


@pytest.mark.parametrize("count", [1, SHARD, 2 * SHARD + 3, COUNT, COUNT + 1])
def test_first_objects_of_a_dataset_are_a_dataset(data: Dataset, count: int) -> None:
    first = data.up_to(count)
    wanted = min(count, COUNT)

    assert len(first) == wanted
    assert sorted(_every_row(first)) == list(range(wanted))
    np.testing.assert_array_equal(first.arrays().image, data.first(count).image)


def test_dataset_stays_as_opened_while_it_is_extended(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    opened = open_dataset(copy)
    before = opened.arrays()
    last = 40 + COUNT - COUNT % SHARD
    longer = samples_of(range(last, last + SHARD))
    store(shard_path(copy, last), longer, PLAN.provenance, "")

    np.testing.assert_array_equal(opened.arrays().image, before.image)
    assert len(open_dataset(copy)) == last + SHARD - 40


def test_command_of_a_shard_may_hold_bytes_that_are_no_text(tmp_path: Path) -> None:
    path = shard_path(tmp_path, 40)
    store(path, samples_of(range(40, 42)), PLAN.provenance, "build --out bad\udcff")

    assert shard_origin(path)[1] == "build --out bad\\udcff"


@pytest.mark.parametrize("name", MAP_CHANNELS)
def test_dataset_is_read_as_stored(data: Dataset, name: str) -> None:
    stored = samples_of(range(40, 40 + COUNT))[name]
    parts = [getattr(part, name) for part in data.chunks()]

    np.testing.assert_array_equal(getattr(data.arrays(), name), stored)
    np.testing.assert_array_equal(np.concatenate(parts), stored)


@pytest.mark.parametrize(("count", "shards"), [(1, 1), (5, 1), (6, 2), (99, 9)])
def test_first_objects_are_read_without_the_other_shards(
    data: Dataset, monkeypatch: pytest.MonkeyPatch, count: int, shards: int
) -> None:
    read = Mock(wraps=reader.read_arrays)
    monkeypatch.setattr(reader, "read_arrays", read)

    first = data.first(count)

    assert read.call_count == shards
    stored = samples_of(range(40, 40 + min(count, COUNT)))
    for name in MAP_CHANNELS:
        np.testing.assert_array_equal(getattr(first, name), stored[name])


@pytest.mark.parametrize("batch", [1, 4, 7, 43, 100])
def test_epoch_holds_samples_once_without_last_partial_batch(data: Dataset, batch: int) -> None:
    size = min(batch, COUNT)

    every = _every_row(data, batch)

    assert {len(some) for some in _rows(data, batch=batch)} == {size}
    assert len(every) == len(set(every)) == COUNT // size * size
    assert set(every) <= set(range(COUNT))


def test_batches_are_samples_mirrored_at_random(data: Dataset) -> None:
    batches = list(data.batches(1, 2, 4))

    for found in batches:
        assert found.depth_m.dtype == found.image.dtype == torch.float32
        _assert_as_stored(found)

    assert 0.2 < torch.cat([found.mirrored for found in batches]).float().mean() < 0.8


def test_batches_repeat_by_seed_and_epoch(data: Dataset) -> None:
    for one, again in zip(data.batches(3, 1, 4), data.batches(3, 1, 4), strict=True):
        for here, there in zip(one, again, strict=True):
            torch.testing.assert_close(here, there, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(("seed", "epoch"), [(3, 2), (4, 1)])
def test_batches_of_another_seed_or_epoch_differ(data: Dataset, seed: int, epoch: int) -> None:
    assert _rows(data, 3, 1) != _rows(data, seed, epoch)


def test_samples_of_three_shards_are_shuffled_together(data: Dataset) -> None:
    shards = np.array(_every_row(data)) // SHARD
    blocks = [set(shards[k : k + 15].tolist()) for k in range(0, 30, 15)]
    runs = np.split(shards, np.flatnonzero(np.diff(shards)) + 1)

    assert any(len(block) == 3 for block in blocks)
    assert shards.tolist() != sorted(shards.tolist())
    assert len({len(run) for run in runs}) > 1


def test_shards_are_read_once(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    read = Mock(wraps=reader.read_arrays)
    monkeypatch.setattr(reader, "read_arrays", read)

    assert len(_every_row(data)) == COUNT

    paths = {call.args[0].path for call in read.call_args_list}

    assert read.call_count == len(paths) == len(data.shards)


def test_two_buffers_of_shards_are_held(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    held = list[int]()
    original_take = _Window.take

    def take(window: _Window, rows: np.ndarray) -> MapSet:
        found = original_take(window, rows)
        held.append(len(window._held))
        return found

    monkeypatch.setattr(_Window, "take", take)

    assert len(_every_row(data)) == COUNT == len(held)
    assert max(held) <= 2 * reader.BUFFER


@pytest.mark.parametrize(
    ("way", "options"), [("arrays", ()), ("batches", (0, 0, 4)), ("chunks", ())]
)
def test_reader_names_damaged_shard(
    folder: Path, tmp_path: Path, way: str, options: tuple[int, ...]
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    victim = tmp_path / "shard-000000050.h5"
    content = bytearray(victim.read_bytes())
    start = len(content) // 3
    stop = len(content) // 2
    content[start:stop] = bytes(stop - start)
    victim.write_bytes(content)

    with pytest.raises(RecordingError, match=r"shard-000000050\.h5") as caught:
        list(getattr(open_dataset(tmp_path), way)(*options))

    assert "\n" not in str(caught.value)


def test_reader_refuses_folder_without_dataset(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nlos-cam dataset build"):
        open_dataset(tmp_path)


def test_reader_opens_expected_maps_where_asked_alone(tmp_path: Path) -> None:
    expected = replace(PLAN, expected=True)
    store(shard_path(tmp_path, 40), samples_of([40]), expected.provenance, "")

    with pytest.raises(RecordingError, match="without --expected-maps"):
        open_dataset(tmp_path)

    assert open_dataset(tmp_path, expected=True).plan.expected


def test_reader_opens_locked_differences_where_asked_alone(tmp_path: Path) -> None:
    locked = replace(PLAN, accuracy=LOCKED)
    store(shard_path(tmp_path, 40), samples_of([40]), locked.provenance, "")

    with pytest.raises(RecordingError, match="locked differences"):
        open_dataset(tmp_path)

    assert open_dataset(tmp_path, locked=True).plan.accuracy == LOCKED


def test_reader_refuses_shards_of_two_datasets(tmp_path: Path, folder: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    other = DatasetPlan(PLAN.rig, 40, accuracy="fine")
    store(shard_path(tmp_path, 90), samples_of(range(90, 92)), other.provenance, "")

    with pytest.raises(RecordingError, match=r"shard-000000090\.h5"):
        open_dataset(tmp_path)
