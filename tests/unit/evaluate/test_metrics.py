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
    spearman,
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
    shown_m = depth_from_image(guess, BOX).astype(np.float64)
    apart_mm = 1000 * (shown_m - depth_from_image(images, BOX))

    found_mm = per_object(guess, images, BOX)["foreground_rmse_mm"]

    expected_mm = np.sqrt(np.nanmean(np.square(apart_mm), axis=(1, 2)))

    np.testing.assert_allclose(found_mm, expected_mm, rtol=1e-4)


def test_interval_lies_about_the_mean_and_repeats() -> None:
    values = np.random.default_rng(1).random(50)

    found = interval(values)

    assert found.value == pytest.approx(values.mean())
    assert found.low < found.value < found.high
    assert interval(values) == found


@pytest.mark.parametrize("count", [7, 54])
def test_resamples_do_not_depend_on_their_blocks(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = np.concatenate([*metrics.resampled(count)])
    monkeypatch.setattr("nlos_cam.evaluate.metrics.BLOCK", 100)
    parts = [*metrics.resampled(count)]

    assert len(parts) > 1
    assert np.array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize(
    ("values", "expected"), [([np.nan] * 2, None), ([0.5], 0.5), ([np.nan, 2], 2)]
)
def test_interval_of_fewer_than_two_values_has_no_ends(
    values: list[float], expected: float | None
) -> None:
    found = interval(np.array(values))

    assert found.value == expected
    assert found.low is None
    assert found.high is None


def test_interval_shrinks_with_root_of_object_count() -> None:
    values = np.random.default_rng(2).normal(size=1600)
    wide = interval(values[:100])
    narrow = interval(values)

    assert (wide.high - wide.low) / (narrow.high - narrow.low) == pytest.approx(4, rel=0.3)
    assert narrow.high - narrow.low == pytest.approx(2 * 1.96 / 40, rel=0.15)


def test_interval_covers_the_truth_at_its_confidence() -> None:
    generator = np.random.default_rng(3)

    found = [interval(generator.exponential(1.0, 54)) for _ in range(150)]

    assert 0.86 < np.mean([one.low <= 1.0 <= one.high for one in found]) <= 1.0


def test_categories_average_to_the_whole(images: np.ndarray) -> None:
    counts = {"cup": 2, "hat": 7, "car": 3}
    categories = [name for name, count in counts.items() for _ in range(count)]
    values = per_object(0.9 * np.roll(images, 3, axis=2), images, BOX)

    by = metrics.per_category(values, categories)

    whole = over_objects(values)

    assert list(by) == list(counts)

    for name in TARGETS:
        total = sum(count * by[category][name].value for category, count in counts.items())
        assert total / len(images) == pytest.approx(whole[name].value)


def _rolled(images: np.ndarray, share: float, by: int) -> dict[str, np.ndarray]:
    """Return the figures of each object of darker images, moved by some pixels."""
    return per_object(share * np.roll(images, by, 2), images, BOX)


@pytest.mark.parametrize("name", TARGETS)
def test_advantage_is_positive_for_the_better_image(images: np.ndarray, name: str) -> None:
    good = _rolled(images, 0.99, 1)
    bad = _rolled(images, 0.9, 9)

    gained = advantage(good, bad)[name]

    assert gained.value > 0
    assert gained.value == pytest.approx(-advantage(bad, good)[name].value)
    assert advantage(good, good)[name].value == 0


@pytest.mark.parametrize(
    ("name", "value", "met"),
    [
        ("silhouette_iou", 0.95, True),
        ("silhouette_iou", 0.85, False),
        ("foreground_rmse_mm", 7.9, True),
        ("foreground_rmse_mm", 8.1, False),
        ("foreground_rmse_mm", np.nan, False),
    ],
)
def test_bar_is_met_from_its_better_side(name: str, value: float, met: bool) -> None:
    assert meets(name, interval(np.array([value]))) == met


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


def test_empty_image_has_no_surface_and_no_detail() -> None:
    assert surface_cm2(EMPTY, BOX)[0] == 0
    assert np.isnan(detail_per_cm(EMPTY, BOX)[0])


@pytest.mark.parametrize("side", [4, 20, 64])
def test_surface_grows_with_the_width_of_the_box(side: int) -> None:
    wide = BOX.model_copy(update={"x_max_m": BOX.x_min_m + 2 * (BOX.x_max_m - BOX.x_min_m)})

    surface = surface_cm2(plate(side, start=0), wide)[0]

    assert surface == pytest.approx(2 * (side * PITCH_CM) ** 2)


BASE = detail_per_cm(plate(20), BOX)[0]
"""Detail of a flat plate without holes."""


def test_detail_grows_with_holes() -> None:
    holed = plate(20)
    holed[:, 15:20, 15:20] = 0

    assert detail_per_cm(holed, BOX)[0] > BASE


def test_detail_grows_with_the_length_of_steps() -> None:
    edge_cm = 20 * PITCH_CM
    stepped = plate(20)
    stepped[:, 20:30, 10:30] += 0.1  # 31 mm

    assert detail_per_cm(stepped, BOX)[0] == pytest.approx(BASE + edge_cm / edge_cm**2)


def test_slopes_are_no_detail() -> None:
    sloping = plate(20)
    sloping[:, 10:30, 10:30] += np.linspace(0, 0.3, 20, dtype=np.float32)

    assert detail_per_cm(sloping, BOX)[0] == pytest.approx(BASE)


LIKE = np.random.default_rng(0).random(54)
COARSE = np.round(4 * LIKE)
"""Equal values share a rank, whatever order they come in."""


def test_curve_bins_every_object_once_and_follows_error() -> None:
    bins = metrics.curve(LIKE, 10 * LIKE)

    assert sum(one.objects for one in bins) == 54
    assert all(one.high <= following.low for one, following in pairwise(bins))
    assert all(10 * one.low <= one.error.value <= 10 * one.high for one in bins)


def test_curve_of_two_objects_has_two_bins() -> None:
    assert len(metrics.curve(LIKE[:2], LIKE[:2])) == 2


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (LIKE, np.exp(9 * LIKE), 1),
        (LIKE, -(LIKE**3), -1),
        (COARSE, COARSE**3, 1),
        (LIKE, np.where(LIKE > 0.9, np.nan, LIKE), 1),
    ],
)
def test_rank_correlation_is_of_order_alone(
    one: np.ndarray, other: np.ndarray, expected: float
) -> None:
    assert rank_correlation(one, other).value == pytest.approx(expected)


def test_spearman_is_the_rank_correlation_also_of_ties() -> None:
    assert spearman(COARSE, LIKE) == rank_correlation(COARSE, LIKE).value
    assert spearman(COARSE, COARSE[::-1] * 0) is None


def test_rank_correlation_is_equal_in_any_order_of_objects() -> None:
    order = np.random.default_rng(3).permutation(54)

    shuffled = rank_correlation(COARSE[order], LIKE[order])

    assert shuffled.value == pytest.approx(rank_correlation(COARSE, LIKE).value)


@pytest.mark.parametrize(("one", "other"), [(LIKE, np.ones(54)), (LIKE[:2], LIKE[:2])])
def test_rank_correlation_of_constant_or_few_values_is_none(
    one: np.ndarray, other: np.ndarray
) -> None:
    assert rank_correlation(one, other).value is None


def test_interval_of_no_rank_correlation_holds_zero() -> None:
    none = rank_correlation(LIKE, np.random.default_rng(2).random(54))

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
def test_zones_locate_an_error(at: tuple[int, int], zone: str) -> None:
    truth = plate(20)
    image = truth.copy()
    image[0][at] += 0.2

    zones = error_by_zone(image, truth)

    assert zones[zone].share_of_error == pytest.approx(1)


def test_zones_share_the_pixels() -> None:
    zones = error_by_zone(plate(20), plate(20))

    assert sum(one.share_of_pixels for one in zones.values()) == pytest.approx(1)
    assert zones["core"].share_of_pixels == pytest.approx(16**2 / 64**2)


def test_zones_of_a_perfect_image_have_no_share_of_error() -> None:
    zones = error_by_zone(plate(9), plate(9))

    assert {zone.share_of_error for zone in zones.values()} == {None}


def test_error_on_an_empty_truth_is_far_background() -> None:
    zones = error_by_zone(plate(9), EMPTY)

    assert zones["far background"].share_of_error == pytest.approx(1)


IOU = np.linspace(0.4, 0.95, 50)


def of_frames(predicted: metrics.Predictions) -> metrics.PredictedFrames:
    """Return frames of these predictions with IOU, two of each object."""
    return metrics.PredictedFrames(predicted, IOU, np.arange(50) // 2)


def test_quality_figures_of_exact_predictions() -> None:
    exact = metrics.Predictions(IOU - 0.05, IOU, IOU + 0.05, np.full(50, 10.0), IOU >= 0.8)

    found = metrics.quality_figures(of_frames(exact))

    assert (found["correlation"], found["mean_error"], found["bias"]) == pytest.approx((1, 0, 0))
    assert found["within_80_percent_interval"] == found["trusted_good"] == 1
    assert found["trusted_objects"] == -(-(IOU >= 0.8).sum() // 2)


def test_quality_figures_of_blind_predictions() -> None:
    low, middle, high = (np.full(50, value) for value in (0.9, 0.95, 1.0))
    blind = metrics.Predictions(low, middle, high, IOU, np.zeros(50, bool))

    found = metrics.quality_figures(of_frames(blind))

    assert found["correlation"] is found["trusted_good"] is None
    assert found["bias"] > 0.2


def _images(pose: Pose, seed: int) -> np.ndarray:
    shapes = (place(category_triangles(name, seed), pose, BOX) for name in CATEGORIES)
    return np.stack([image_from_depth(orthographic_depth(shape, BOX), BOX) for shape in shapes])


@pytest.mark.parametrize(
    "pose",
    [
        Pose(size_m=0.2),
        Pose(size_m=0.12, x_m=0.05, y_m=-0.04),
        Pose(turn_z_rad=0.3, tilt_y_rad=0.2),
    ],
)
def test_kinds_are_recognised_in_any_place_and_size(pose: Pose) -> None:
    assert recognised(_images(pose, 1000), list(CATEGORIES), BOX).mean() > 0.8


def test_kinds_are_not_recognised_as_another_or_without_surface() -> None:
    cup = _images(Pose(), 7)[list(CATEGORIES).index("cup")]
    images = np.stack([EMPTY[0], cup])

    assert recognise(images, BOX) == ["", "cup"]
    np.testing.assert_array_equal(recognised(images, ["cup", "rocket"], BOX), [0, 0])
