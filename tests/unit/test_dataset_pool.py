"""Processes as a farm: what they make is what this one makes; those that are killed are replaced, or told."""

from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from fake_farm import FakeFarm, samples_of
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import build
from nlos_cam.dataset import build as dataset
from nlos_cam.dataset.build import DatasetPlan, Farm, open_dataset, processes
from nlos_cam.dataset.samples import make_samples
from nlos_cam.errors import WorkersLostError

PLAN = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft")


@pytest.fixture(autouse=True)
def _small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "SHARD", 5)
    monkeypatch.setattr(dataset, "PIECE", 2)


def _build(folder: Path, farm: Farm) -> None:
    build(PLAN, 23, folder, workers=1, on_progress=lambda *_: None, farm=farm)


def _bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("shard-*")}


@pytest.fixture
def whole(tmp_path: Path) -> dict[str, bytes]:
    """The shards of a build that nothing disturbed."""
    _build(tmp_path / "whole", FakeFarm())
    return _bytes(tmp_path / "whole")


class InThisProcess:
    """Stands for a pool of processes, which may be killed after some pieces."""

    dies_after: list[int]

    def __init__(self, workers: int, **_: object) -> None:
        self.workers, self.left = workers, self.dies_after.pop(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self.left:
            self.left -= 1
            future.set_result(work(*arguments))
        else:
            future.set_exception(BrokenProcessPool("killed"))
        return future


@pytest.fixture
def dying(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def dies(*after: int) -> None:
        monkeypatch.setattr(InThisProcess, "dies_after", [*after], raising=False)
        monkeypatch.setattr(dataset, "ProcessPoolExecutor", InThisProcess)
        monkeypatch.setattr(dataset, "make_samples", lambda _, piece: samples_of(piece))

    return dies


def test_a_killed_worker_is_replaced(tmp_path: Path, whole: dict[str, bytes], dying: Callable[..., None]) -> None:
    dying(1, 4, 100)
    _build(tmp_path / "other", processes(2))
    assert _bytes(tmp_path / "other") == whole


def test_workers_that_die_at_once_end_the_build_with_what_is_kept(
    tmp_path: Path, whole: dict[str, bytes], dying: Callable[..., None]
) -> None:
    dying(7, 0)
    with pytest.raises(WorkersLostError, match=r"finished shards are kept.*fewer --workers"):
        _build(tmp_path / "other", processes(2))
    assert 0 < len(_bytes(tmp_path / "other")) <= 2
    dying(100)
    _build(tmp_path / "other", processes(2))
    assert _bytes(tmp_path / "other") == whole


def test_real_processes_make_what_this_one_makes_and_leave_nobody(tmp_path: Path) -> None:
    build(PLAN, 4, tmp_path, workers=2, on_progress=lambda *_: None)
    for name, values in make_samples(PLAN, range(40, 44)).items():
        np.testing.assert_array_equal(open_dataset(tmp_path).column(name), values)
    assert not active_children()
