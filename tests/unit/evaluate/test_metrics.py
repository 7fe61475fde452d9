"""Evaluation metrics, their confidence intervals, the error by size, detail and place, and
recognised kinds.
"""

from itertools import pairwise

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.dataset import procedural_images
from nlos_cam.evaluate import TARGETS, advantage, judge, metrics, over_objects, per_object
from nlos_cam.evaluate.metrics import (
    detail_per_cm,
    error_by_zone,
    interval,
    meets,
    rank_correlation,
    surface_cm2,
)
from nlos_cam.evaluate.recognition import recognise, recognised
from nlos_cam.objects import (
    CATEGORIES,
    category_triangles,
    image_from_depth,
    object_box,
    orthographic_depth,
)
from nlos_cam.objects.depth_map import depth_from_image
from nlos_cam.objects.placement import Pose, place

BOX = object_box(load_rig("paper-rig"))
PITCH_CM = 25 / 64
PERFECT = {
    "silhouette_iou": 1,
    "accuracy_mean_abs": 1,
    "accuracy_within_2_percent": 1,
    "foreground_rmse_mm": 0,
}
EMPTY = np.zeros((1, 64, 64), np.float32)


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return procedural_images(0, 12, BOX).astype(np.float32)


def test_judge_scores_perfect_image_without_uncertainty(images: np.ndarray) -> None:
    figures = judge(images, images, BOX)
    assert {name: figure.value for name, figure in figures.items()} == PERFECT
    assert all(figure.low == figure.value == figure.high for figure in figures.values())
    assert all(bar["met"] for bar in metrics.targets_met(figures).values())


@pytest.mark.parametrize("seed", range(3))
def test_foreground_rmse_is_that_of_the_depth_live_shows(images: np.ndarray, seed: int) -> None:
    guess = np.random.default_rng(seed).random(images.shape).astype(np.float32)
    guess[:, ::2] *= 0.15  # background, and depths beyond the box
    apart_mm = 1000 * (
        depth_from_image(guess, BOX).astype(np.float64) - depth_from_image(images, BOX)
    )
    expected = np.sqrt(np.nanmean(np.square(apart_mm), axis=(1, 2)))
    np.testing.assert_allclose(
        per_object(guess, images, BOX)["foreground_rmse_mm"], expected, rtol=1e-4
    )


def test_interval_covers_the_truth_at_its_confidence_repeats_and_shrinks_with_root_of_object_count() -> (
    None
):
    values = np.random.default_rng(1).random(50)
    found = interval(values)
    assert found.value == pytest.approx(values.mean())
    assert found.low < found.value < found.high
    assert interval(values) == found
    for some, expected in (
        ([np.nan] * 2, None),
        ([0.5], 0.5),
        ([np.nan, 2], 2),
    ):  # without a value, left out
        found = interval(np.array(some))
        assert found.value == found.low == found.high == expected
    values = np.random.default_rng(2).normal(size=1600)
    wide = interval(values[:100])
    narrow = interval(values)
    assert (wide.high - wide.low) / (narrow.high - narrow.low) == pytest.approx(4, rel=0.3)
    assert narrow.high - narrow.low == pytest.approx(2 * 1.96 / 40, rel=0.15)
    generator = np.random.default_rng(3)
    found = [interval(generator.exponential(1.0, 54)) for _ in range(150)]
    assert 0.86 < np.mean([one.low <= 1.0 <= one.high for one in found]) <= 1.0


def test_categories_average_to_the_whole(images: np.ndarray) -> None:
    categories = ["cup"] * 2 + ["hat"] * 7 + ["car"] * 3
    values = per_object(0.9 * np.roll(images, 3, axis=2), images, BOX)
    by = metrics.per_category(values, categories)
    whole = over_objects(values)
    assert list(by) == ["cup", "hat", "car"]
    for name in TARGETS:
        weighed = sum(
            categories.count(category) * by[category][name].value for category in by
        ) / len(images)
        assert weighed == pytest.approx(whole[name].value)


def test_advantage_is_positive_for_the_better_image_and_bar_is_met_from_its_better_side(
    images: np.ndarray,
) -> None:
    good, bad = (
        per_object(share * np.roll(images, by, 2), images, BOX)
        for share, by in ((0.99, 1), (0.9, 9))
    )
    for name in TARGETS:
        gained = advantage(good, bad)[name]
        lost = advantage(bad, good)[name]
        assert gained.value > 0
        assert gained.value == pytest.approx(-lost.value)
        assert advantage(good, good)[name].value == 0
    for name, values in {
        "silhouette_iou": (0.95, 0.85),
        "foreground_rmse_mm": (7.9, 8.1, np.nan),
    }.items():
        assert [meets(name, interval(np.array([value]))) for value in values] == [
            True,
            False,
            False,
        ][: len(values)]


def plate(side: int, v: float = 0.6, start: int = 10) -> np.ndarray:
    image = EMPTY.copy()
    image[:, start : start + side, start : start + side] = v
    return image


@pytest.mark.parametrize("side", [4, 20, 64])
def test_surface_and_detail_of_square_plate(side: int) -> None:
    image = plate(side, start=0)
    edge_cm = side * PITCH_CM
    assert surface_cm2(image, BOX)[0] == pytest.approx(edge_cm**2)
    assert detail_per_cm(image, BOX)[0] == pytest.approx(4 / edge_cm)
    assert surface_cm2(EMPTY, BOX)[0] == 0
    assert np.isnan(detail_per_cm(EMPTY, BOX)[0])
    wide = BOX.model_copy(update={"x_max_m": BOX.x_min_m + 2 * (BOX.x_max_m - BOX.x_min_m)})
    assert surface_cm2(image, wide)[0] == pytest.approx(2 * edge_cm**2)


def test_detail_grows_with_holes_and_steps_not_slopes() -> None:
    whole, holed, stepped, sloping = (plate(20) for _ in range(4))
    holed[:, 15:20, 15:20] = 0
    stepped[:, 20:30, 10:30] += 0.1  # 31 mm
    sloping[:, 10:30, 10:30] += np.linspace(0, 0.3, 20, dtype=np.float32)
    base = detail_per_cm(whole, BOX)[0]
    assert detail_per_cm(holed, BOX)[0] > base
    assert detail_per_cm(stepped, BOX)[0] == pytest.approx(
        base + 20 * PITCH_CM / (20 * PITCH_CM) ** 2
    )
    assert detail_per_cm(sloping, BOX)[0] == pytest.approx(base)


def test_curve_bins_every_object_once_and_follows_error_and_rank_correlation_is_of_order_alone() -> (
    None
):
    like = np.random.default_rng(0).random(54)
    bins = metrics.curve(like, 10 * like)
    assert sum(one.objects for one in bins) == 54
    assert all(one.high <= following.low for one, following in pairwise(bins))
    assert all(10 * one.low <= one.error.value <= 10 * one.high for one in bins)
    assert len(metrics.curve(like[:2], like[:2])) == 2
    coarse = np.round(4 * like)  # equal values share a rank, whatever order they come in
    order = np.random.default_rng(3).permutation(54)
    with_gaps = np.where(like > 0.9, np.nan, like)
    pairs = (like, np.exp(9 * like)), (like, -(like**3)), (coarse, coarse**3), (like, with_gaps)
    assert [rank_correlation(*pair).value for pair in pairs] == pytest.approx([1, -1, 1, 1])
    assert rank_correlation(coarse[order], like[order]).value == pytest.approx(
        rank_correlation(coarse, like).value
    )
    assert (
        rank_correlation(like, np.ones(54)).value
        is rank_correlation(like[:2], like[:2]).value
        is None
    )
    none = rank_correlation(like, np.random.default_rng(2).random(54))
    assert none.low < 0 < none.high


@pytest.mark.parametrize(
    ("at", "zone"),
    [
        ((20, 20), "core"),
        ((10, 20), "rim inside"),
        ((8, 20), "rim outside"),
        ((50, 50), "far background"),
    ],
)
def test_zones_locate_an_error_and_share_none_of_a_perfect_image(
    at: tuple[int, int], zone: str
) -> None:
    truth = plate(20)
    image = truth.copy()
    image[0][at] += 0.2
    zones = error_by_zone(image, truth)
    assert zones[zone].share_of_error == pytest.approx(1)
    assert sum(one.share_of_pixels for one in zones.values()) == pytest.approx(1)
    assert zones["core"].share_of_pixels == pytest.approx(16**2 / 64**2)
    assert {zone.share_of_error for zone in error_by_zone(plate(9), plate(9)).values()} == {None}
    assert error_by_zone(plate(9), EMPTY)["far background"].share_of_error == pytest.approx(1)


def test_quality_figures_of_exact_and_of_blind_predictions() -> None:
    iou = np.linspace(0.4, 0.95, 50)
    exact = metrics.Predictions(iou - 0.05, iou, iou + 0.05, np.full(50, 10.0), iou >= 0.8)
    found = metrics.quality_figures(exact, iou)
    assert (found["correlation"], found["mean_error"], found["bias"]) == pytest.approx((1, 0, 0))
    assert found["within_80_percent_interval"] == found["trusted_good"] == 1
    assert found["trusted_objects"] == (iou >= 0.8).sum()
    blind = metrics.Predictions(iou * 0 + 0.9, iou * 0 + 0.95, iou * 0 + 1, iou, np.zeros(50, bool))
    found = metrics.quality_figures(blind, iou)
    assert found["correlation"] is found["trusted_good"] is None
    assert found["bias"] > 0.2


def _images(pose: Pose, seed: int) -> np.ndarray:
    shapes = (place(category_triangles(name, seed), pose, BOX) for name in CATEGORIES)
    return np.stack([image_from_depth(orthographic_depth(shape, BOX), BOX) for shape in shapes])


def test_kinds_are_recognised_in_any_place_and_size_but_not_as_another_or_without_surface() -> None:
    kinds = list(CATEGORIES)
    for pose in (
        Pose(size_m=0.2),
        Pose(size_m=0.12, x_m=0.05, y_m=-0.04),
        Pose(turn_z_rad=0.3, tilt_y_rad=0.2),
    ):
        assert recognised(_images(pose, 1000), kinds, BOX).mean() > 0.8
    images = np.stack(
        [np.zeros((64, 64), np.float32), _images(Pose(), 7)[list(CATEGORIES).index("cup")]]
    )
    assert recognise(images, BOX) == ["", "cup"]
    np.testing.assert_array_equal(recognised(images, ["cup", "rocket"], BOX), [0, 0])
