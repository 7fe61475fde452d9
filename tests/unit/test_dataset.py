"""Datasets: the same arrays for any number of workers and after any stop; other plans and broken shards are refused."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.data import MapSet

from nlos_cam import dataset
from nlos_cam.dataset import DatasetPlan, build, procedural_images, read, sense_object
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.objects.depth_image import image_from_depth
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render.sensor import Sensor
from nlos_cam.render.sensor_model import SensorModel

PLAN = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft")
COUNT, SHARD = 6, 2


class InThisProcess:
    """Stands for a pool of processes: starting those takes seconds, and one test does."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(work(*arguments))
        return future


@pytest.fixture(autouse=True)
def _small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "SHARD", SHARD)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "ProcessPoolExecutor", InThisProcess)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "SHARD", SHARD)
        patch.setattr(dataset, "ProcessPoolExecutor", InThisProcess)
        build(PLAN, COUNT, folder, workers=1, on_progress=lambda *_: None)
    return folder


@pytest.fixture
def copied(built: Path, tmp_path: Path) -> Path:
    for shard in built.iterdir():
        (tmp_path / shard.name).write_bytes(shard.read_bytes())
    return tmp_path


def _rebuild(folder: Path, count: int = COUNT, plan: DatasetPlan = PLAN) -> list[tuple[int, int]]:
    seen: list[tuple[int, int]] = []
    build(plan, count, folder, workers=1, on_progress=lambda done, total: seen.append((done, total)))
    return seen


def _assert_same(one: MapSet, other: MapSet) -> None:
    for name in dataset.MAP_CHANNELS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_two_processes_make_the_same_arrays(built: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    build(PLAN, COUNT, tmp_path, workers=2, on_progress=lambda done, total: seen.append((done, total)))
    _assert_same(read(tmp_path)[0], read(built)[0])
    assert seen == [(0, 6), (2, 6), (4, 6), (6, 6)]


def test_it_holds_the_objects_of_its_seeds_in_order(built: Path) -> None:
    maps, plan = read(built)
    assert plan == PLAN
    assert maps.depth_m.shape == maps.intensity.shape == (COUNT, 64, 80)
    assert maps.image.shape == (COUNT, 64, 64)
    assert maps.image.dtype == np.float16
    np.testing.assert_array_equal(maps.image, procedural_images(PLAN.first_seed, COUNT, PLAN.box))
    sensor = Sensor(PLAN.rig, PLAN.sensor)
    for k in (0, COUNT - 1):
        seed = PLAN.first_seed + k
        sensed = sense_object(object_depth(seed, PLAN.box)[1], sensor, seed, "draft")
        np.testing.assert_array_equal(maps.depth_m[k], sensed.depth_m)
        np.testing.assert_array_equal(maps.intensity[k], sensed.intensity)


def test_a_shard_says_what_it_is(built: Path) -> None:
    shards = sorted(built.iterdir())
    assert len(shards) == COUNT // SHARD
    with h5py.File(shards[1]) as file:
        assert file.attrs["plan"] == PLAN.provenance
        assert file["seed"][:].tolist() == [42, 43]
        names = [category.decode() for category in file["category"][:]]
        assert names == [object_depth(seed, PLAN.box)[0] for seed in (42, 43)]
        for image, depth in zip(file["image"], file["object_depth_m"], strict=True):
            np.testing.assert_array_equal(image, image_from_depth(depth, PLAN.box).astype(np.float16))


@pytest.mark.usefixtures("in_this_process")
def test_a_missing_shard_is_made_again_and_the_others_are_kept(built: Path, copied: Path) -> None:
    first, second, third = sorted(copied.iterdir())
    second.unlink()
    (copied / f"{second.stem}.part").write_bytes(b"a kill left this")
    times = first.stat().st_mtime_ns, third.stat().st_mtime_ns
    assert _rebuild(copied) == [(4, 6), (6, 6)]
    assert (first.stat().st_mtime_ns, third.stat().st_mtime_ns) == times
    assert sorted(copied.iterdir()) == [first, second, third]
    _assert_same(read(copied)[0], read(built)[0])


@pytest.mark.usefixtures("in_this_process")
def test_a_whole_dataset_is_left_alone(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "_build_shard", lambda *_: pytest.fail("built again"))
    assert _rebuild(copied) == [(6, 6)]


@pytest.mark.usefixtures("in_this_process")
def test_a_dataset_grows_to_the_count_asked_for(built: Path, tmp_path: Path) -> None:
    """3 objects leave a shard half full: asking for 6 must not take it for a whole one."""
    _rebuild(tmp_path, count=3)
    assert len(read(tmp_path)[0].image) == 3
    _rebuild(tmp_path, count=6)
    _assert_same(read(tmp_path)[0], read(built)[0])


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("change", ["rig", "first_seed", "sensor", "accuracy"])
def test_another_plan_is_refused(copied: Path, change: str) -> None:
    rig, sensor, seed, accuracy = PLAN.rig, PLAN.sensor, PLAN.first_seed, PLAN.accuracy
    if change == "rig":
        rig = rig.model_copy(update={"name": "other"})
    if change == "sensor":
        sensor = SensorModel(shot_noise=0)
    other = DatasetPlan(rig, seed + (change == "first_seed"), sensor, "fine" if change == "accuracy" else accuracy)
    before = sorted(copied.iterdir())
    with pytest.raises(RecordingError, match="choose another --out"):
        _rebuild(copied, plan=other)
    assert sorted(copied.iterdir()) == before


@pytest.mark.parametrize("harm", ["empty", "text", "truncated", "channel"])
def test_a_corrupt_shard_says_which_and_what_to_do(copied: Path, harm: str) -> None:
    shard = sorted(copied.iterdir())[1]
    if harm == "channel":
        with h5py.File(shard, "a") as file:
            del file["intensity"]
    else:
        whole = shard.read_bytes()
        shard.write_bytes({"empty": b"", "text": b"not HDF5 at all", "truncated": whole[: len(whole) // 2]}[harm])
    with pytest.raises(RecordingError, match=rf"{shard.name}.*delete it and build again"):
        read(copied)


@pytest.mark.usefixtures("in_this_process")
def test_a_corrupt_first_shard_stops_a_build_with_the_same_words(copied: Path) -> None:
    shard = min(copied.iterdir())
    shard.write_bytes(b"")
    with pytest.raises(RecordingError, match=rf"{shard.name}.*delete it and build again"):
        _rebuild(copied)


def test_no_dataset_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nlos-cam dataset build"):
        read(tmp_path)


def test_a_failing_object_ends_the_build_with_its_error(tmp_path: Path) -> None:
    """Through a real pool: the error of a worker is the error of the build."""
    with pytest.raises(SceneError, match="no accuracy 'wrong'"):
        build(DatasetPlan(PLAN.rig, 0, accuracy="wrong"), 2, tmp_path, workers=1, on_progress=lambda *_: None)
    assert not list(tmp_path.glob("*.h5"))


def test_a_rig_without_a_box_has_nowhere_to_hide_objects() -> None:
    with pytest.raises(SceneError, match="object_box"):
        _ = DatasetPlan(load_rig("bare-wall"), 0).box


def test_the_noise_of_an_object_is_its_own() -> None:
    sensor, depth = Sensor(PLAN.rig, PLAN.sensor), object_depth(0, PLAN.box)[1]
    first, again, other = (sense_object(depth, sensor, seed, "draft") for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.depth_m, again.depth_m)
    assert not np.array_equal(first.depth_m, other.depth_m, equal_nan=True)


def test_seeds_of_the_three_kinds_are_far_apart() -> None:
    starts = dataset.TRAINING_SEED, dataset.HELD_OUT_SEED, dataset.TEST_SEED
    assert np.diff(starts).min() >= 1_000_000
