"""Baselines answer every object; the nearest neighbour of a training object is that object; maps are built once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import LidarPose, load_rig
from nlos_models.data import MapSet

from nlos_cam import dataset, evaluate_baselines
from nlos_cam.dataset import DatasetPlan, procedural_images
from nlos_cam.evaluate_baselines import baselines, training_maps
from nlos_cam.objects.depth_image import object_box

RIG = load_rig("paper-rig")


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return procedural_images(0, 12, object_box(RIG)).astype(np.float32)


def _maps(images: np.ndarray, seed: int = 0) -> MapSet:
    """Maps from which the image can be told apart, with holes and noise."""
    generator = np.random.default_rng(seed)
    wide = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8)))
    depth = wide + 0.01 * generator.standard_normal(wide.shape).astype(np.float32)
    depth[:, :5, :5] = np.nan
    return MapSet(depth.astype(np.float32), 50 * wide, images)


def test_baselines_answer_every_object(images: np.ndarray) -> None:
    training, judged = _maps(images), _maps(images[:5], seed=1)
    guesses = baselines(judged, images.astype(np.float16), training)
    assert set(guesses) == {"all_background", "mean_object", "nearest_neighbour"}
    for guess in guesses.values():
        assert guess.shape == (5, 64, 64)
        assert guess.dtype == np.float32
    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][3], images.mean(0), atol=1e-3)


def test_the_nearest_neighbour_finds_the_object_itself(images: np.ndarray) -> None:
    order = np.array([7, 2, 11, 0])
    guesses = baselines(_maps(images[order], seed=1), images.astype(np.float16), _maps(images))
    np.testing.assert_array_equal(guesses["nearest_neighbour"], images[order])


def test_without_training_maps_there_is_no_nearest_neighbour(images: np.ndarray) -> None:
    assert set(baselines(_maps(images), images.astype(np.float16), None)) == {"all_background", "mean_object"}


def test_training_maps_are_kept_by_what_decides_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[tuple[DatasetPlan, int, Path]] = []
    monkeypatch.setattr(dataset, "build", lambda plan, count, folder, **_: built.append((plan, count, folder)))
    monkeypatch.setattr(dataset, "read", lambda folder: (folder, None))
    monkeypatch.setattr(evaluate_baselines, "NEIGHBOURS", 7)
    plan = DatasetPlan(RIG, dataset.TEST_SEED, objects=dataset.Objects(("cup",)))
    elsewhere = RIG.model_copy(update={"lidar": LidarPose(distance_m=0.3, yaw_deg=45)})
    for one in (plan, plan, replace(plan, rig=elsewhere), replace(plan, first_seed=5)):
        training_maps(one, tmp_path, 1, lambda *_: None)
    first, again, moved, other_seed = (folder for _, _, folder in built)
    assert first == again == other_seed
    assert moved != first
    assert first.parent.parent == tmp_path
    assert built[0][1] == 7
    assert (built[0][0].first_seed, built[0][0].objects) == (dataset.TRAINING_SEED, dataset.Objects())
