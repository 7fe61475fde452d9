"""Builds: the same shards for any workers, in any order and after any stop; damage is made anew, others are refused."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_farm import FakeFarm, samples_of
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import build
from nlos_cam.dataset import build as dataset
from nlos_cam.dataset.build import Built, DatasetPlan, open_dataset
from nlos_cam.dataset.shards import LOCK, SHARDS, only_builder, store
from nlos_cam.errors import (
    DiskFullError,
    FolderBusyError,
    OutputExistsError,
    RecordingError,
    SceneError,
)

PLAN = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft")
COUNT, SHARD, PIECE = 23, 5, 2
LAST = "shard-000000060.h5"
"""The one with three objects."""


@pytest.fixture(autouse=True)
def _small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "SHARD", SHARD)
    monkeypatch.setattr(dataset, "PIECE", PIECE)


def _build(folder: Path, farm: FakeFarm | None = None, count: int = COUNT, **others: Any) -> Built:
    options = {"workers": 1, "on_progress": lambda *_: None, "farm": farm or FakeFarm(), **others}
    return build(options.pop("plan", PLAN), count, folder, **options)


def _bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*") if not path.name.startswith(".")}


@pytest.fixture
def whole(tmp_path: Path) -> dict[str, bytes]:
    """The shards of a build that nothing disturbed."""
    _build(tmp_path / "whole")
    return _bytes(tmp_path / "whole")


def test_it_holds_the_samples_of_its_seeds_in_order(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    built = _build(tmp_path, on_progress=lambda done, total: seen.append((done, total)))
    found = open_dataset(tmp_path)
    assert (built.objects, built.made, built.damaged) == (COUNT, COUNT, ())
    assert (len(found), found.plan) == (COUNT, PLAN)
    for name, values in samples_of(range(40, 40 + COUNT)).items():
        np.testing.assert_array_equal(found.column(name), values)
    assert [done for done, _ in seen] == [0, 2, 4, 5, 7, 9, 10, 12, 14, 15, 17, 19, 20, 22, 23]
    assert {total for _, total in seen} == {COUNT}


@pytest.mark.parametrize("order", [0, 1, 2])
def test_any_order_makes_the_same_shards(tmp_path: Path, whole: dict[str, bytes], order: int) -> None:
    _build(tmp_path / "other", FakeFarm(order))
    assert _bytes(tmp_path / "other") == whole


@pytest.mark.parametrize("after", [0, 1, 2, 3, 7, 11, 13])
@pytest.mark.parametrize("order", [None, 3])
def test_a_stop_anywhere_costs_no_finished_shard(
    tmp_path: Path, whole: dict[str, bytes], after: int, order: int | None
) -> None:
    """And the second run makes what is missing, nothing twice."""
    folder, farm = tmp_path / "stopped", FakeFarm(order, fails_after=after)
    with pytest.raises(KeyboardInterrupt):
        _build(folder, farm)
    assert farm.closed
    kept = _bytes(folder)
    assert kept.items() <= whole.items()
    if order is None:
        assert len(kept) == after // 3  # three pieces make a shard
    rest = FakeFarm()
    built = _build(folder, rest)
    assert _bytes(folder) == whole
    again = [seed for piece in rest.made for seed in piece]
    assert len(again) == len(set(again)) == built.made == COUNT - sum(3 if name == LAST else 5 for name in kept)


def test_the_error_of_an_object_is_the_error_of_the_build(tmp_path: Path) -> None:
    farm = FakeFarm(fails_after=4, error=SceneError("cup.stl shows nothing"))
    with pytest.raises(SceneError, match=r"cup\.stl"):
        _build(tmp_path, farm)
    assert farm.closed
    assert len(_bytes(tmp_path)) == 1


def test_what_a_kill_left_half_written_is_cleaned_away_and_never_counted(
    tmp_path: Path, whole: dict[str, bytes]
) -> None:
    folder = tmp_path / "killed"
    _build(folder, count=10)
    content = (folder / "shard-000000040.h5").read_bytes()
    (folder / "shard-000000045.h5").rename(folder / "shard-000000045.part")
    (folder / "shard-000000050.part").write_bytes(content[:100])
    assert len(open_dataset(folder)) == 5
    _build(folder)
    assert _bytes(folder) == whole


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.99])
def test_a_damaged_shard_is_made_anew_and_told(tmp_path: Path, whole: dict[str, bytes], keep: float) -> None:
    folder, told = tmp_path / "whole", list[str]()
    path = folder / "shard-000000045.h5"
    path.write_bytes(whole[path.name][: int(keep * len(whole[path.name]))])
    built = _build(folder, tell=told.append)
    assert told == [f"{path} is damaged: it is made anew"]
    assert (built.made, built.damaged) == (5, (path,))
    assert _bytes(folder) == whole


def test_a_damaged_shard_beyond_the_count_is_told_and_left(tmp_path: Path, whole: dict[str, bytes]) -> None:
    del whole
    folder, told = tmp_path / "whole", list[str]()
    (folder / "shard-000000060.h5").write_bytes(b"")
    built = _build(folder, count=10, tell=told.append)
    assert (built.made, built.damaged) == (0, ())
    assert len(told) == 1
    assert "shard-000000060.h5 is damaged" in told[0]


def test_a_whole_dataset_is_left_alone(tmp_path: Path, whole: dict[str, bytes]) -> None:
    farm, checked = FakeFarm(), list[tuple[int, int]]()
    built = _build(tmp_path / "whole", farm, on_check=lambda done, total: checked.append((done, total)))
    assert (farm.made, built.made) == ([], 0)
    assert checked == [(k, 5) for k in range(1, 6)]
    assert _bytes(tmp_path / "whole") == whole


@pytest.mark.parametrize("first", [1, 5, 7, 22])
def test_a_dataset_grows_to_the_count_asked_for(tmp_path: Path, whole: dict[str, bytes], first: int) -> None:
    """7 objects leave a shard half full: asking for more must not take it for a whole one."""
    _build(tmp_path / "grown", count=first)
    assert len(open_dataset(tmp_path / "grown")) == first
    assert _build(tmp_path / "grown").made == COUNT - first // 5 * 5
    assert _bytes(tmp_path / "grown") == whole


def test_another_plan_is_refused_and_says_in_what(tmp_path: Path, whole: dict[str, bytes]) -> None:
    other = replace(PLAN, accuracy="fine", rig=PLAN.rig.model_copy(update={"name": "other"}))
    with pytest.raises(RecordingError, match=r"another rig, accuracy: choose another --out"):
        _build(tmp_path / "whole", plan=other)
    assert _bytes(tmp_path / "whole") == whole


def test_a_newer_programs_shard_is_not_taken_for_a_damaged_one(tmp_path: Path) -> None:
    newer = PLAN.provenance.replace('{"rig"', '{"lens": 1, "rig"', 1)
    store(tmp_path / "shard-000000040.h5", samples_of(range(40, 45)), newer, "")
    before = _bytes(tmp_path)
    with pytest.raises(RecordingError, match="'lens', which this nlos-cam does not know: update it"):
        _build(tmp_path)
    assert _bytes(tmp_path) == before


def test_shards_of_another_size_are_refused(
    tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "SHARD", 4)
    with pytest.raises(RecordingError, match="holds 5 objects, not up to 4"):
        _build(tmp_path / "whole")
    assert _bytes(tmp_path / "whole") == whole


def test_two_builds_at_once_are_refused(tmp_path: Path) -> None:
    with only_builder(tmp_path), pytest.raises(FolderBusyError, match=f"process {os.getpid()}"):
        _build(tmp_path)
    _build(tmp_path)
    assert (tmp_path / LOCK).exists()


def test_a_full_disk_keeps_the_shards_so_far(
    tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    stores: list[Path] = []

    def full(path: Path, *others: Any) -> None:
        stores.append(path)
        if len(stores) == 3:
            raise DiskFullError(f"no room for {path}")
        store(path, *others)

    monkeypatch.setattr(dataset, "store", full)
    farm = FakeFarm()
    with pytest.raises(DiskFullError):
        _build(tmp_path / "full", farm)
    assert farm.closed
    assert len(list((tmp_path / "full").glob(SHARDS))) == 2
    _build(tmp_path / "full")
    assert _bytes(tmp_path / "full") == whole


def test_a_folder_that_cannot_be_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("here")
    with pytest.raises(OutputExistsError, match="choose another --out"):
        _build(tmp_path / "file")


def test_seeds_of_the_three_kinds_are_far_apart() -> None:
    starts = dataset.TRAINING_SEED, dataset.HELD_OUT_SEED, dataset.TEST_SEED
    assert np.diff(starts).min() >= 1_000_000
