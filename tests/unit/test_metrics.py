"""Metrics against hand-made images."""

import numpy as np
import pytest
from nlos_models import metrics

EMPTY = np.zeros((1, 64, 64), np.float32)


def _square(v: float, rows: slice = slice(10, 20), columns: slice = slice(10, 20)) -> np.ndarray:
    image = EMPTY.copy()
    image[:, rows, columns] = v
    return image


def test_the_truth_scores_perfectly() -> None:
    truth = _square(0.7)
    assert metrics.accuracy_mean_abs(truth, truth) == 1
    assert metrics.accuracy_within_2_percent(truth, truth) == 1
    assert metrics.silhouette_iou(truth, truth) == 1
    assert metrics.foreground_rmse_mm(truth, truth, 300.0) == 0


def test_mean_abs_counts_every_pixel() -> None:
    assert metrics.accuracy_mean_abs(_square(0.5), EMPTY)[0] == pytest.approx(1 - 0.5 * 100 / 4096)


def test_within_2_percent_is_a_share_of_all_pixels() -> None:
    truth = _square(0.5)
    near, far = _square(0.515), _square(0.53)
    assert metrics.accuracy_within_2_percent(near, truth)[0] == 1
    assert metrics.accuracy_within_2_percent(far, truth)[0] == pytest.approx(1 - 100 / 4096)


def test_iou_of_half_overlapping_squares_is_a_third() -> None:
    shifted = _square(0.9, columns=slice(15, 25))
    assert metrics.silhouette_iou(_square(0.4), shifted)[0] == pytest.approx(50 / 150)


def test_iou_looks_at_masks_only_and_background_is_below_5_percent() -> None:
    assert metrics.silhouette_iou(_square(0.06), _square(1.0)) == 1
    assert metrics.silhouette_iou(_square(0.04), _square(1.0)) == 0


def test_two_empty_images_agree() -> None:
    assert metrics.silhouette_iou(EMPTY, EMPTY) == 1
    assert metrics.accuracy_mean_abs(EMPTY, EMPTY) == 1
    assert np.isnan(metrics.foreground_rmse_mm(EMPTY, EMPTY, 300.0))


def test_an_empty_answer_to_an_object_has_no_overlap_and_no_depth() -> None:
    assert metrics.silhouette_iou(EMPTY, _square(0.5)) == 0
    assert np.isnan(metrics.foreground_rmse_mm(EMPTY, _square(0.5), 300.0))
    apart = _square(0.5, rows=slice(40, 50))
    assert np.isnan(metrics.foreground_rmse_mm(apart, _square(0.5), 300.0))


def test_rmse_is_over_shared_pixels_in_mm() -> None:
    image = _square(0.6, columns=slice(10, 30))
    assert metrics.foreground_rmse_mm(image, _square(0.5), 300.0)[0] == pytest.approx(30, rel=1e-5)


def test_nothing_is_farther_than_the_farthest_surface() -> None:
    assert metrics.foreground_rmse_mm(_square(0.06), _square(metrics.LEAST_V), 300.0)[0] == pytest.approx(0, abs=1e-6)
    assert metrics.foreground_rmse_mm(_square(0.06), _square(0.2), 300.0)[0] == pytest.approx(30, rel=1e-5)


def test_there_is_one_value_per_object() -> None:
    image = np.concatenate([_square(0.5), EMPTY, _square(0.2)])
    truth = np.concatenate([_square(0.5)] * 3)
    assert metrics.silhouette_iou(image, truth).tolist() == [1, 0, 1]
    for values in (
        metrics.accuracy_mean_abs(image, truth),
        metrics.accuracy_within_2_percent(image, truth),
        metrics.foreground_rmse_mm(image, truth, 1.0),
    ):
        assert values.shape == (3,)
