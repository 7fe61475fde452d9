"""Baselines of an evaluation: background, mean object and nearest training object; training maps are built once."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from nlos_calibration import LidarPose, load_rig
from nlos_models import MapSet

from nlos_cam.dataset import TEST_SEED, TRAINING_SEED, DatasetPlan, Objects, procedural_images
from nlos_cam.evaluate import baselines
from nlos_cam.evaluate.baselines import answers_with_nearest, mean_image, training_maps, trivial_answers
from nlos_cam.objects import CATEGORIES, object_box, object_depth

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


class Chunked(SimpleNamespace):
    """Training maps in parts of some size."""

    maps: MapSet
    size: int

    def __len__(self) -> int:
        return len(self.maps.image)

    def chunks(self) -> list[MapSet]:
        arrays, parts = vars(self.maps).values(), range(0, len(self), self.size)
        return [MapSet(*(array[start : start + self.size] for array in arrays)) for start in parts]


def _guesses(sought: MapSet, training: MapSet, size: int = 12, **others: object) -> dict[str, np.ndarray]:
    options = {"on_progress": lambda *_: None, **others}
    return answers_with_nearest(sought, Chunked(maps=training, size=size), **options)  # type: ignore[arg-type]


def test_baselines_answer_every_object(images: np.ndarray) -> None:
    mean = mean_image(images.astype(np.float16))
    np.testing.assert_allclose(mean, images.mean(0), atol=1e-3)
    alone, guesses = trivial_answers(5, mean), _guesses(_maps(images[:5], seed=1), _maps(images))
    assert set(alone) == {"all_background", "mean_object"}
    assert set(guesses) == {*alone, "nearest_neighbour"}
    for guess in (*alone.values(), *guesses.values()):
        assert (guess.shape, guess.dtype) == ((5, 64, 64), np.float32)
    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][3], images.mean(0), atol=1e-3)


@pytest.mark.parametrize("size", [1, 5, 12])
def test_nearest_neighbour_is_found_in_any_chunk(images: np.ndarray, size: int) -> None:
    order, told = np.array([7, 2, 11, 0]), list[tuple[int, int]]()
    sought = _maps(images[order], seed=1)
    guesses = _guesses(sought, _maps(images), size, on_progress=lambda *at: told.append(at))
    np.testing.assert_array_equal(guesses["nearest_neighbour"], images[order])
    assert (len(told), told[-1]) == (-(-12 // size), (12, 12))


@pytest.mark.parametrize("scale", [1e-6, 0.0])
def test_nearest_neighbour_weighs_channels_by_their_spread(images: np.ndarray, scale: float) -> None:
    """A channel that never varies counts for nothing."""
    faint = [replace(maps, intensity=scale * maps.intensity) for maps in (_maps(images[:4], seed=1), _maps(images))]
    np.testing.assert_array_equal(_guesses(*faint)["nearest_neighbour"], images[:4])


def test_training_maps_are_cached_by_what_determines_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[tuple[DatasetPlan, int, Path]] = []
    shapes = {"images": np.zeros((2, 64, 64), np.float16)}
    monkeypatch.setattr(baselines, "build_dataset", lambda *args, **_: built.append(args))
    monkeypatch.setattr(baselines, "open_dataset", lambda folder: folder)
    monkeypatch.setattr(baselines, "procedural_images", lambda *_: shapes["images"])
    monkeypatch.setattr(baselines, "NEIGHBOURS", 7)
    plan = DatasetPlan(RIG, TEST_SEED, objects=Objects(("cup",)))
    elsewhere = RIG.model_copy(update={"lidar": LidarPose(distance_m=0.3, yaw_deg=45)})
    for one in (plan, plan, replace(plan, rig=elsewhere), replace(plan, first_seed=5)):
        training_maps(one, tmp_path, 1, lambda *_: None)
    shapes["images"] = shapes["images"] + np.float16(0.5)
    training_maps(plan, tmp_path, 1, lambda *_: None)
    first, again, moved, other_seed, other_shapes = (folder for _, _, folder in built)
    assert first == again == other_seed
    assert len({first, moved, other_shapes}) == 3
    assert first.parent.parent == tmp_path
    assert built[0][1] == 7
    assert (built[0][0].first_seed, built[0][0].objects) == (TRAINING_SEED, Objects())


def test_objects_that_identify_the_cache_cover_all_categories() -> None:
    seen = {object_depth(seed, object_box(RIG))[0] for seed in range(baselines.FINGERPRINT_OBJECTS)}
    assert seen == set(CATEGORIES)
