"""Judging: perfection scores 1, intervals hold their estimate, baselines are what they say."""

from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.data import MapSet

from nlos_cam import evaluate
from nlos_cam.dataset import TEST_SEED, procedural_images
from nlos_cam.evaluate import baselines, draw_sheet, interval, judge, reconstruct_all, sense_test_objects
from nlos_cam.objects.depth_image import image_from_depth
from nlos_cam.objects.hidden import object_depth

RIG = load_rig("paper-rig")
PERFECT = {"silhouette_iou": 1, "accuracy_mean_abs": 1, "accuracy_within_2_percent": 1, "foreground_rmse_mm": 0}


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    assert RIG.object_box is not None
    return procedural_images(0, 12, RIG.object_box).astype(np.float32)


def _maps(images: np.ndarray, seed: int = 0) -> MapSet:
    """Maps from which the image can be told apart, with holes and noise."""
    generator = np.random.default_rng(seed)
    wide = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8)))
    depth = wide + 0.01 * generator.standard_normal(wide.shape).astype(np.float32)
    depth[:, :5, :5] = np.nan
    return MapSet(depth.astype(np.float32), 50 * wide, images)


def test_a_perfect_image_scores_perfectly_with_no_doubt(images: np.ndarray) -> None:
    figures = judge(images, images, 311.0)
    assert {name: figure.value for name, figure in figures.items()} == PERFECT
    assert all(figure.low == figure.value == figure.high for figure in figures.values())


def test_a_worse_image_scores_worse(images: np.ndarray) -> None:
    near, far = judge(0.99 * images, images, 311.0), judge(0.8 * np.roll(images, 10, axis=2), images, 311.0)
    for name, sign in (("silhouette_iou", 1), ("accuracy_mean_abs", 1), ("foreground_rmse_mm", -1)):
        assert sign * near[name].value > sign * far[name].value


def test_an_interval_contains_its_mean_and_is_repeatable() -> None:
    values = np.random.default_rng(1).random(50)
    found = interval(values)
    assert found.value == pytest.approx(values.mean())
    assert found.low < found.value < found.high
    assert interval(values) == found


def test_an_interval_shrinks_with_the_root_of_the_objects() -> None:
    values = np.random.default_rng(2).normal(size=1600)
    wide, narrow = interval(values[:100]), interval(values)
    assert (wide.high - wide.low) / (narrow.high - narrow.low) == pytest.approx(4, rel=0.3)
    assert narrow.high - narrow.low == pytest.approx(2 * 1.96 / 40, rel=0.15)


def test_objects_without_a_value_are_left_out() -> None:
    assert interval(np.array([np.nan, 1.0, 3.0])).value == 2
    empty = interval(np.array([np.nan, np.nan]))
    assert (empty.value, empty.low, empty.high) == (None, None, None)
    one = interval(np.array([0.5]))
    assert (one.value, one.low, one.high) == (0.5, 0.5, 0.5)


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


class Echo:
    """A reconstructor that answers with the middle of the depth map."""

    runtime = "none"

    def __init__(self) -> None:
        self.batches: list[int] = []

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert intensity.shape == depth_m.shape
        self.batches.append(len(depth_m))
        return np.nan_to_num(depth_m[:, :, 8:72])


def test_objects_are_reconstructed_one_at_a_time_in_order(images: np.ndarray) -> None:
    reconstructor, maps = Echo(), _maps(images)
    made = reconstruct_all(reconstructor, maps)  # type: ignore[arg-type]
    assert reconstructor.batches == [1] * len(images)
    np.testing.assert_array_equal(made, np.nan_to_num(maps.depth_m[:, :, 8:72]))


def test_test_objects_come_through_the_simulated_camera_and_are_those_of_their_seeds() -> None:
    assert RIG.object_box is not None
    seen: list[tuple[int, int]] = []
    maps = sense_test_objects(RIG, RIG.object_box, TEST_SEED, 2, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    assert maps.depth_m.shape == maps.intensity.shape == (2, 64, 80)
    for k in range(2):
        expected = image_from_depth(object_depth(TEST_SEED + k, RIG.object_box)[1], RIG.object_box)
        np.testing.assert_array_equal(maps.image[k], expected)
    again = sense_test_objects(RIG, RIG.object_box, TEST_SEED + 1, 1, lambda *_: None)
    same = np.abs(again.depth_m[0] - maps.depth_m[1]) < 0.003  # another frame's noise; ties may go the other way
    assert same.mean() > 0.98


@pytest.mark.parametrize("count", [1, 12])
def test_a_sheet_is_a_picture_for_any_number_of_objects(tmp_path: Path, images: np.ndarray, count: int) -> None:
    path = tmp_path / "sheet.png"
    draw_sheet(path, images[:count], images[:count], rows=1)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert evaluate.SHEET_COLUMNS == 10
