"""Labelled samples as a dataset: what is read is what was written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.data import MapSet

from nlos_cam.dataset import build
from nlos_cam.dataset import labelled as labelled_shards
from nlos_cam.dataset.labelled import RECORDED, Labelled, write_shards
from nlos_cam.dataset.shards import store
from nlos_cam.errors import DiskFullError, RecordingError

RIG = load_rig("paper-rig").model_copy(update={"name": "bench"})


def _labelled(count: int) -> Labelled:
    generator = np.random.default_rng(count)
    depth_m, intensity = generator.random((2, count, 64, 80), np.float32)
    depth_m[:, 0, 0] = np.nan
    truth_m = generator.uniform(0.12, 0.4, (count, 64, 64)).astype(np.float32)
    names = tuple(f"cup-{k}" for k in range(count))
    return Labelled(MapSet(depth_m, intensity, truth_m.astype(np.float16)), truth_m, names, names, RIG)


@pytest.mark.parametrize("count", [3, build.SHARD + 7])
def test_what_is_read_is_what_was_written(tmp_path: Path, count: int) -> None:
    labelled = _labelled(count)
    write_shards(labelled, tmp_path)
    maps, plan = build.read(tmp_path)
    for name in ("depth_m", "intensity", "image"):
        np.testing.assert_array_equal(getattr(maps, name), getattr(labelled.maps, name))
    kept = build.open_dataset(tmp_path)
    assert tuple(kept.column("category")) == labelled.label
    np.testing.assert_array_equal(kept.column("object_depth_m"), labelled.object_depth_m)
    assert np.isnan(kept.column("scene")).any(axis=0).sum() == 1  # the gain is not known
    assert plan.rig == RIG
    assert plan.accuracy == RECORDED


def test_a_smaller_dataset_leaves_nothing_of_a_larger_one(tmp_path: Path) -> None:
    for count in (build.SHARD + 7, 4):
        write_shards(_labelled(count), tmp_path)
    assert len(build.read(tmp_path)[0].image) == 4


def test_a_full_disk_keeps_the_dataset_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, stored = tmp_path / "data", list[Path]()
    write_shards(_labelled(build.SHARD + 7), out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def full(path: Path, *others: Any) -> None:
        stored.append(path)
        if len(stored) == 2:
            raise DiskFullError(f"no room for {path}")
        store(path, *others)

    monkeypatch.setattr(labelled_shards, "store", full)
    with pytest.raises(DiskFullError, match=f"no room for the dataset {out}: what was there is kept"):
        write_shards(_labelled(build.SHARD + 9), out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert list(tmp_path.iterdir()) == [out]


def test_nothing_rendered_is_mixed_into_what_was_recorded(tmp_path: Path) -> None:
    write_shards(_labelled(4), tmp_path)
    with pytest.raises(RecordingError, match="choose another --out"):
        build.build(build.DatasetPlan(RIG, 0), 4, tmp_path, workers=1, on_progress=lambda *_: None)
