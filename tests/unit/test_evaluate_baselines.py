"""Baselines answer every object; the nearest neighbour of a training object is that object; maps are built once."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import LidarPose, load_rig
from nlos_models.data import MapSet

from nlos_cam.dataset import build
from nlos_cam.dataset.build import DatasetPlan, procedural_images
from nlos_cam.evaluate import baselines
from nlos_cam.evaluate.baselines import mean_image, training_maps, with_nearest, without_maps
from nlos_cam.objects.depth_map import object_box

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


class Chunked:
    """Training maps in parts of so many."""

    def __init__(self, maps: MapSet, size: int) -> None:
        self._maps, self._size = maps, size

    def __len__(self) -> int:
        return len(self._maps.image)

    def chunks(self) -> Iterator[MapSet]:
        for start in range(0, len(self), self._size):
            part = slice(start, start + self._size)
            yield MapSet(self._maps.depth_m[part], self._maps.intensity[part], self._maps.image[part])


def _quiet(*_: int) -> None:
    pass


def test_baselines_answer_every_object(images: np.ndarray) -> None:
    guesses = with_nearest(_maps(images[:5], seed=1), Chunked(_maps(images), 12), _quiet)
    assert set(guesses) == {"all_background", "mean_object", "nearest_neighbour"}
    for guess in guesses.values():
        assert guess.shape == (5, 64, 64)
        assert guess.dtype == np.float32
    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][3], images.mean(0), atol=1e-3)


@pytest.mark.parametrize("size", [1, 5, 12])
def test_the_nearest_neighbour_finds_the_object_itself_in_whatever_part_it_is(images: np.ndarray, size: int) -> None:
    order = np.array([7, 2, 11, 0])
    told: list[tuple[int, int]] = []
    training = Chunked(_maps(images), size)
    guesses = with_nearest(_maps(images[order], seed=1), training, lambda done, total: told.append((done, total)))
    np.testing.assert_array_equal(guesses["nearest_neighbour"], images[order])
    assert (len(told), told[-1]) == (-(-12 // size), (12, 12))


def test_depth_weighs_as_much_as_intensity_whatever_their_units(images: np.ndarray) -> None:
    training, sought = _maps(images), _maps(images[:4], seed=1)
    faint = [replace(maps, intensity=maps.intensity * 1e-6) for maps in (training, sought)]
    found = [
        with_nearest(mine, Chunked(its, 12), _quiet)["nearest_neighbour"] for its, mine in ((training, sought), faint)
    ]
    np.testing.assert_array_equal(*found)


def test_a_channel_that_never_varies_tells_nothing_and_breaks_nothing(images: np.ndarray) -> None:
    training, sought = _maps(images), _maps(images[:4], seed=1)
    dark = [replace(maps, intensity=np.zeros_like(maps.intensity)) for maps in (training, sought)]
    found = with_nearest(dark[1], Chunked(dark[0], 12), _quiet)["nearest_neighbour"]
    np.testing.assert_array_equal(found, images[:4])


def test_without_maps_there_is_no_nearest_neighbour(images: np.ndarray) -> None:
    mean = mean_image(images.astype(np.float16))
    np.testing.assert_allclose(mean, images.mean(0), atol=1e-3)
    guesses = without_maps(5, mean)
    assert set(guesses) == {"all_background", "mean_object"}
    assert {guess.shape for guess in guesses.values()} == {(5, 64, 64)}


def test_training_maps_are_kept_by_what_decides_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[tuple[DatasetPlan, int, Path]] = []
    shapes = {"images": np.zeros((2, 64, 64), np.float16)}
    monkeypatch.setattr(build, "build", lambda plan, count, folder, **_: built.append((plan, count, folder)))
    monkeypatch.setattr(build, "open_dataset", lambda folder: folder)
    monkeypatch.setattr(build, "procedural_images", lambda *_: shapes["images"])
    monkeypatch.setattr(baselines, "NEIGHBOURS", 7)
    plan = DatasetPlan(RIG, build.TEST_SEED, objects=build.Objects(("cup",)))
    elsewhere = RIG.model_copy(update={"lidar": LidarPose(distance_m=0.3, yaw_deg=45)})
    for one in (plan, plan, replace(plan, rig=elsewhere), replace(plan, first_seed=5)):
        training_maps(one, tmp_path, 1, _quiet)
    shapes["images"] = shapes["images"] + np.float16(0.5)
    training_maps(plan, tmp_path, 1, _quiet)
    first, again, moved, other_seed, other_shapes = (folder for _, _, folder in built)
    assert first == again == other_seed
    assert len({first, moved, other_shapes}) == 3
    assert first.parent.parent == tmp_path
    assert built[0][1] == 7
    assert (built[0][0].first_seed, built[0][0].objects) == (build.TRAINING_SEED, build.Objects())


def test_every_category_is_among_those_that_tell_whether_objects_are_still_made_as_they_were() -> None:
    from nlos_cam.objects.generators import CATEGORIES
    from nlos_cam.objects.placement import object_depth

    seen = {object_depth(seed, object_box(RIG))[0] for seed in range(baselines.TOLD_BY)}
    assert seen == set(CATEGORIES)
