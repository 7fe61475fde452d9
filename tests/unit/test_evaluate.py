"""Judging: perfection scores 1, intervals hold their estimate, categories weigh up to the whole."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.build import procedural_images
from nlos_cam.evaluate.metrics import (
    BARS,
    advantage,
    bars_met,
    interval,
    judge,
    meets,
    mm_per_v,
    over_objects,
    per_category,
    per_object,
    plain,
)
from nlos_cam.objects.depth_map import depth_from_image, object_box

BOX = object_box(load_rig("paper-rig"))
PERFECT = {"silhouette_iou": 1, "accuracy_mean_abs": 1, "accuracy_within_2_percent": 1, "foreground_rmse_mm": 0}


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return procedural_images(0, 12, BOX).astype(np.float32)


def test_a_perfect_image_scores_perfectly_with_no_doubt(images: np.ndarray) -> None:
    figures = judge(images, images, BOX)
    assert {name: figure.value for name, figure in figures.items()} == PERFECT
    assert all(figure.low == figure.value == figure.high for figure in figures.values())
    assert all(bar["met"] for bar in bars_met(figures).values())


def test_a_worse_image_scores_worse(images: np.ndarray) -> None:
    near, far = judge(0.99 * images, images, BOX), judge(0.8 * np.roll(images, 10, axis=2), images, BOX)
    for name, sign in (("silhouette_iou", 1), ("accuracy_mean_abs", 1), ("foreground_rmse_mm", -1)):
        assert sign * near[name].value > sign * far[name].value


def test_depth_errors_are_in_millimetres_of_the_box(images: np.ndarray) -> None:
    off = np.where(images > 0.2, images - 0.05, images).astype(np.float32)
    moved_m = depth_from_image(off, BOX) - depth_from_image(images, BOX)
    assert 1000 * np.nanmax(moved_m) == pytest.approx(0.05 * mm_per_v(BOX), rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_depth_error_is_that_of_the_depth_that_live_shows(images: np.ndarray, seed: int) -> None:
    guess = np.random.default_rng(seed).random(images.shape).astype(np.float32)
    guess[:, ::2] *= 0.15  # background, and what is too far away to be
    apart_mm = 1000 * (depth_from_image(guess, BOX).astype(np.float64) - depth_from_image(images, BOX))
    expected = np.sqrt(np.nanmean(np.square(apart_mm), axis=(1, 2)))
    np.testing.assert_allclose(per_object(guess, images, BOX)["foreground_rmse_mm"], expected, rtol=1e-4)


def test_plain_figures_have_three_numbers_each(images: np.ndarray) -> None:
    figures = judge(0.99 * images, images, BOX)
    for name, figure in plain(figures).items():
        assert figure == {end: getattr(figures[name], end) for end in ("value", "low", "high")}


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


def test_an_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(3)
    found = [interval(generator.exponential(1.0, 54)) for _ in range(150)]
    assert 0.86 < np.mean([one.low <= 1.0 <= one.high for one in found]) <= 1.0


def test_objects_without_a_value_are_left_out() -> None:
    assert interval(np.array([np.nan, 1.0, 3.0])).value == 2
    empty = interval(np.array([np.nan, np.nan]))
    assert (empty.value, empty.low, empty.high) == (None, None, None)
    one = interval(np.array([0.5]))
    assert (one.value, one.low, one.high) == (0.5, 0.5, 0.5)


def test_categories_weigh_up_to_the_whole(images: np.ndarray) -> None:
    categories = ["cup"] * 2 + ["hat"] * 7 + ["car"] * 3
    values = per_object(0.9 * np.roll(images, 3, axis=2), images, BOX)
    by, whole = per_category(values, categories), over_objects(values)
    assert list(by) == ["cup", "hat", "car"]
    for name in BARS:
        weighed = sum(categories.count(category) * by[category][name].value for category in by) / len(images)
        assert weighed == pytest.approx(whole[name].value)


def test_an_advantage_is_positive_where_ours_is_better_in_every_metric(images: np.ndarray) -> None:
    good, bad = (per_object(share * np.roll(images, by, 2), images, BOX) for share, by in ((0.99, 1), (0.9, 9)))
    for name in BARS:
        gained, lost = advantage(good, bad)[name], advantage(bad, good)[name]
        assert gained.value > 0
        assert gained.value == pytest.approx(-lost.value)
        assert advantage(good, good)[name].value == 0


def test_a_bar_is_met_by_the_estimate_from_its_own_side() -> None:
    assert meets("silhouette_iou", interval(np.array([0.95])))
    assert not meets("silhouette_iou", interval(np.array([0.85])))
    assert meets("foreground_rmse_mm", interval(np.array([7.9])))
    assert not meets("foreground_rmse_mm", interval(np.array([8.1])))
    assert not meets("foreground_rmse_mm", interval(np.array([np.nan])))
