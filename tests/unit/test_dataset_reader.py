"""Reading: whole or streamed, the same samples; an epoch is a matter of seed and epoch, not of who reads."""

from pathlib import Path

import numpy as np
import pytest
import torch
from fake_farm import samples_of
from nlos_calibration.rig import load_rig
from nlos_models.data import MapBatch

from nlos_cam.dataset import reader
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.reader import MAP_CHANNELS, Dataset, open_dataset, read
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import RecordingError, SceneError

PLAN = DatasetPlan(load_rig("paper-rig"), 40)
COUNT, SHARD = 43, 5


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


def _rows(data: Dataset, seed: int = 0, epoch: int = 0, batch: int = 4, **others: int) -> list[list[int]]:
    return [found.row.tolist() for found in data.batches(seed, epoch, batch, **others)]


def _assert_as_stored(found: MapBatch) -> None:
    samples = samples_of([40 + row for row in found.row.tolist()])
    for k, mirrored in enumerate(found.mirrored.tolist()):
        turn = slice(None, None, -1 if mirrored else 1)
        np.testing.assert_array_equal(found.depth_m[k], samples["depth_m"][k][turn])
        np.testing.assert_array_equal(found.intensity[k], samples["intensity"][k][turn])
        np.testing.assert_array_equal(found.image[k, 0], samples["image"][k][turn].astype(np.float32))


def test_whole_it_is_what_was_stored(data: Dataset, folder: Path) -> None:
    maps, plan = read(folder)
    assert (len(data), plan) == (COUNT, PLAN)
    for name in MAP_CHANNELS:
        np.testing.assert_array_equal(getattr(maps, name), samples_of(range(40, 40 + COUNT))[name])
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, name) for part in data.chunks()]), getattr(maps, name)
        )
    np.testing.assert_array_equal(data.column("seed"), np.arange(40, 40 + COUNT))
    assert data.column("category").tolist()[:4] == ["kind-1", "kind-2", "kind-0", "kind-1"]


def test_an_epoch_has_every_sample_once_but_for_the_last_smaller_batch(data: Dataset) -> None:
    for batch in (1, 4, 7, 43):
        rows = _rows(data, batch=batch)
        assert {len(some) for some in rows} == {batch}
        every = [row for some in rows for row in some]
        assert len(every) == len(set(every)) == COUNT // batch * batch
        assert set(every) <= set(range(COUNT))


def test_fewer_samples_than_a_batch_are_one_batch(data: Dataset) -> None:
    assert [sorted(rows) for rows in _rows(data, batch=100)] == [list(range(COUNT))]


def test_each_row_is_its_sample_mirrored_or_not(data: Dataset) -> None:
    batches = list(data.batches(1, 2, 4))
    for found in batches:
        assert found.depth_m.dtype == found.image.dtype == torch.float32
        _assert_as_stored(found)
    mirrored = torch.cat([found.mirrored for found in batches])
    assert 0.2 < mirrored.float().mean() < 0.8


def test_an_epoch_is_repeatable_and_another_is_another(data: Dataset) -> None:
    for one, again in zip(data.batches(3, 1, 4), data.batches(3, 1, 4), strict=True):
        for here, there in zip(one, again, strict=True):
            torch.testing.assert_close(here, there, rtol=0, atol=0, equal_nan=True)
    assert _rows(data, 3, 1) != _rows(data, 3, 2)
    assert _rows(data, 3, 1) != _rows(data, 4, 1)


@pytest.mark.parametrize("world", [2, 3])
def test_processes_share_the_batches_that_one_would_see(data: Dataset, world: int) -> None:
    alone = list(data.batches(0, 0, 6))
    shares = [list(data.batches(0, 0, 6, rank=rank, world=world)) for rank in range(world)]
    for number, whole in enumerate(alone):
        for rank in range(world):
            share = shares[rank][number]
            assert share.row.tolist() == whole.row.tolist()[rank::world]
            assert share.mirrored.tolist() == whole.mirrored.tolist()[rank::world]
            _assert_as_stored(share)


@pytest.mark.parametrize(("rank", "world"), [(0, 4), (2, 2), (-1, 2)])
def test_a_batch_that_cannot_be_shared_is_refused(data: Dataset, rank: int, world: int) -> None:
    with pytest.raises(SceneError, match="cannot be shared"):
        next(data.batches(0, 0, 6, rank=rank, world=world))


def test_samples_travel_within_the_buffer_and_shards_anywhere(data: Dataset) -> None:
    rows = np.array([row for some in _rows(data, batch=1) for row in some])
    shards = rows // SHARD
    blocks = [set(shards[k : k + 15].tolist()) for k in range(0, 30, 15) if len(set(shards[k : k + 15].tolist())) == 3]
    assert blocks  # three shards of five samples, shuffled together
    assert shards.tolist() != sorted(shards.tolist())
    assert len({len(list(run)) for run in np.split(shards, np.flatnonzero(np.diff(shards)) + 1)}) > 1


def test_no_more_is_in_memory_than_two_buffers_and_each_shard_is_read_once(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: list[Path] = []
    original = reader._maps

    def counted(shard: reader.Shard) -> list[np.ndarray]:
        reads.append(shard.path)
        return original(shard)

    windows: list[reader._Window] = []
    original_take = reader._Window.take

    def take(window: reader._Window, rows: np.ndarray) -> reader.MapSet:
        windows.append(window)
        found = original_take(window, rows)
        assert len(window._held) <= 2 * reader.BUFFER
        return found

    monkeypatch.setattr(reader, "_maps", counted)
    monkeypatch.setattr(reader._Window, "take", take)
    assert len(_rows(data, batch=1)) == COUNT == len(windows)
    assert len(reads) == len(set(reads)) == len(data.shards)


def test_a_damaged_shard_is_one_clear_line_whichever_way_it_is_read(folder: Path, tmp_path: Path) -> None:
    for shard in folder.iterdir():
        (tmp_path / shard.name).write_bytes(shard.read_bytes())
    victim = tmp_path / "shard-000000050.h5"
    content = bytearray(victim.read_bytes())
    content[len(content) // 3 : len(content) // 2] = bytes(len(content) // 2 - len(content) // 3)
    victim.write_bytes(content)
    for look in (
        read,
        lambda where: list(open_dataset(where).batches(0, 0, 4)),
        lambda where: list(open_dataset(where).chunks()),
    ):
        with pytest.raises(RecordingError, match=r"shard-000000050\.h5 is damaged .*build again") as caught:
            look(tmp_path)
        assert "\n" not in str(caught.value)


def test_no_dataset_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nlos-cam dataset build"):
        read(tmp_path)


def test_shards_of_two_datasets_are_refused(folder: Path, tmp_path: Path) -> None:
    for shard in folder.iterdir():
        (tmp_path / shard.name).write_bytes(shard.read_bytes())
    other = DatasetPlan(PLAN.rig, 40, accuracy="fine")
    store(shard_path(tmp_path, 90), samples_of(range(90, 92)), other.provenance, "")
    with pytest.raises(RecordingError, match="is of another dataset"):
        open_dataset(tmp_path)
