"""Datasets whose objects are each on a known rig of its own: every training sees their maps as the
one rig of the weights does.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_uncertainty import RECIPE
from fake_workers import samples_of
from nlos_calibration import load_rig
from nlos_models import load_record, shipped_folder
from nlos_models.training import MapSet

from nlos_cam.dataset import (
    RECORDED,
    Benches,
    Dataset,
    DatasetPlan,
    RigRange,
    RigSpread,
    open_dataset,
    open_packed_maps,
    quality_set,
    uncertainty_samples,
    uncertainty_sets,
)
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.dataset.uncertainty_samples import EMPTY, UncertaintySamples
from nlos_cam.errors import SceneError
from nlos_cam.reconstruct import WALL_GRID

OBJECTS = 4
RECORD = load_record(shipped_folder())
PLAN = DatasetPlan(load_rig("paper-rig"), 0, spread=RigSpread(place_m=0.004, angle_deg=40))


class Network:
    """Network of the paper's rig that keeps the maps that it is given."""

    record = RECORD

    def __init__(self) -> None:
        self.depth_m: list[np.ndarray] = []
        self.intensity: list[np.ndarray] = []

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        self.depth_m.extend(depth_m)
        self.intensity.extend(intensity)
        return np.full((len(depth_m), 64, 64), 0.5, np.float32)


@pytest.fixture
def built(tmp_path: Path) -> Callable[..., Path]:
    """Make a dataset of noise with the plan's rigs."""

    def build(name: str, plan: DatasetPlan = PLAN) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        first = plan.first_seed
        noise = np.random.default_rng(first)
        maps = {
            key: noise.random((OBJECTS, 64, 80), np.float32) for key in ("depth_m", "intensity")
        }
        image = noise.random((OBJECTS, 64, 64), np.float32).astype(np.float16)
        samples = {**samples_of(range(first, first + OBJECTS)), **maps, "image": image}
        store(shard_path(folder, first), samples, plan.provenance, "")
        return folder

    return build


@pytest.fixture
def wanted(built: Callable[..., Path], tmp_path: Path) -> Callable[[Path], MapSet]:
    """Return a dataset's maps as `train direct` takes them."""

    def read(folder: Path) -> MapSet:
        beside = built(f"beside-{folder.name}", replace(PLAN, first_seed=1000))
        with open_packed_maps([beside], tmp_path / f"packed-{folder.name}") as packed:
            maps = packed.held_out(folder, OBJECTS)
        assert 0 < len(maps.image) < OBJECTS
        return maps

    return read


@pytest.fixture
def small_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of the quality model, and rendered samples, that take no time."""
    monkeypatch.setattr(
        uncertainty_samples.models, "quality_features", lambda image, *_: np.zeros((len(image), 1))
    )
    maps = np.ones((1, 64, 80), np.float32)
    image = np.zeros((1, 64, 64), np.float16)
    empty = UncertaintySamples(maps, maps, image, np.zeros(1, np.int32), np.array([EMPTY]))
    monkeypatch.setattr(uncertainty_samples, "samples_on_disk", lambda *_, **__: empty)


@pytest.mark.usefixtures("small_models")
def test_quality_model_sees_maps_as_the_direct_network_does(
    built: Callable[..., Path], wanted: Callable[[Path], MapSet]
) -> None:
    folder = built("maps")
    network = Network()
    judge: Any = lambda *_: None  # noqa: E731

    found = quality_set(network, judge, open_dataset(folder), OBJECTS, lambda *_: None)

    aligned = wanted(folder)
    assert len(found.figures) == len(aligned.image)
    np.testing.assert_array_equal(np.stack(network.depth_m), aligned.depth_m)
    np.testing.assert_array_equal(np.stack(network.intensity), aligned.intensity)


def test_quality_model_of_fewer_objects_than_wanted_is_refused(built: Callable[..., Path]) -> None:
    dataset = open_dataset(built("maps"))
    judge: Any = lambda *_: None  # noqa: E731

    with pytest.raises(SceneError, match=f"holds {OBJECTS} objects, and 6000 are wanted"):
        quality_set(Network(), judge, dataset, 6000, lambda *_: None)


def test_quality_model_of_one_kind_is_refused_before_its_work(
    built: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = open_dataset(built("maps"))
    kinds = np.array(["cup"] * OBJECTS, object)
    monkeypatch.setattr(Dataset, "column", lambda *_: kinds)
    network = Network()
    judge: Any = lambda *_: None  # noqa: E731

    with pytest.raises(SceneError, match=r"too few \(cup\)"):
        quality_set(network, judge, dataset, OBJECTS, lambda *_: None)

    assert not network.depth_m


@pytest.mark.usefixtures("small_models")
def test_uncertainty_network_sees_maps_as_the_direct_one_does(
    built: Callable[..., Path], wanted: Callable[[Path], MapSet], tmp_path: Path
) -> None:
    folders = [built("maps"), built("held-out", replace(PLAN, first_seed=100))]
    datasets = open_dataset(folders[0]), open_dataset(folders[1])

    found = uncertainty_sets(RECIPE, Network(), datasets, tmp_path)

    for folder, one in zip(folders, found, strict=True):
        aligned = wanted(folder)
        assert one.nothing.tolist() == [False] * len(aligned.image) + [True]
        np.testing.assert_array_equal(one.depth_m[:-1], aligned.depth_m)
        np.testing.assert_array_equal(one.intensity[:-1], aligned.intensity)


@pytest.mark.usefixtures("small_models")
def test_maps_that_are_off_their_record_are_not_aligned(built: Callable[..., Path]) -> None:
    dataset = open_dataset(built("maps", replace(PLAN, off_record=True)))
    network = Network()
    judge: Any = lambda *_: None  # noqa: E731

    quality_set(network, judge, dataset, OBJECTS, lambda *_: None)

    np.testing.assert_array_equal(np.stack(network.depth_m), dataset.arrays().depth_m)


def test_samples_of_many_rigs_are_aligned_with_the_weights_rig() -> None:
    many = replace(PLAN, rigs=RigRange())
    grid = RECORD.model_copy(update={"rig_checksum": WALL_GRID.checksum})

    assert Benches.of(many, RECORD).maps_rig == PLAN.rig
    assert Benches.of(many, grid).maps_rig == WALL_GRID
    assert Benches.of(PLAN, RECORD).maps_rig is None


@pytest.mark.parametrize(
    ("bench", "plan"),
    [
        (None, PLAN),  # weights for any rig, objects of one
        (PLAN.rig.model_dump(mode="json"), replace(PLAN, rigs=RigRange())),
        (load_rig("wide-rig").model_dump(mode="json"), PLAN),
    ],
)
def test_quality_on_the_wall_grid_is_of_the_weights_own_rigs(
    built: Callable[..., Path], bench: dict[str, Any] | None, plan: DatasetPlan
) -> None:
    network: Any = Network()
    network.record = RECORD.model_copy(update={"rig_checksum": WALL_GRID.checksum, "rig": bench})

    with pytest.raises(SceneError, match="own rig"):
        quality_set(network, Mock(), open_dataset(built("maps", plan)), OBJECTS, Mock())


def test_samples_beside_recordings_are_rendered() -> None:
    assert Benches.of(replace(PLAN, accuracy=RECORDED), RECORD).accuracy == "draft"
