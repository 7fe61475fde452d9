"""Metrics of depth and color images against hand-made images."""

import numpy as np
import pytest
from nlos_models.arrays import Float32
from nlos_models.metrics import (
    MIN_V,
    accuracy_mean_abs,
    accuracy_within_2_percent,
    brightness,
    color_accuracy_mean_abs,
    color_error,
    color_metrics,
    color_silhouette_iou,
    foreground_rmse_mm,
    root_mean_square_error,
    silhouette_iou,
)

EMPTY = np.zeros((1, 64, 64), np.float32)


def _square(v: float, rows: slice = slice(10, 20), columns: slice = slice(10, 20)) -> np.ndarray:
    image = EMPTY.copy()
    image[:, rows, columns] = v
    return image


def _colored(color: tuple[float, float, float], rows: slice = slice(16, 48)) -> Float32:
    image = np.zeros((1, 3, 64, 64), np.float32)
    image[:, :, rows, 16:48] = 0.1 + 0.9 * np.array(color, np.float32)[:, None, None]
    return image


@pytest.mark.parametrize("truth", [_square(0.7), EMPTY])
def test_equal_images_score_perfectly(truth: np.ndarray) -> None:
    assert accuracy_mean_abs(truth, truth) == 1
    assert accuracy_within_2_percent(truth, truth) == 1
    assert silhouette_iou(truth, truth) == 1
    rmse = foreground_rmse_mm(truth, truth, 300.0)
    assert rmse == 0 if truth.any() else np.isnan(rmse)


def test_accuracies_count_every_pixel() -> None:
    assert accuracy_mean_abs(_square(0.5), EMPTY)[0] == pytest.approx(1 - 0.5 * 100 / 4096)
    assert accuracy_within_2_percent(_square(0.515), _square(0.5))[0] == 1
    assert accuracy_within_2_percent(_square(0.53), _square(0.5))[0] == pytest.approx(1 - 100 / 4096)


def test_silhouette_iou_compares_masks_above_5_percent() -> None:
    shifted = _square(0.9, columns=slice(15, 25))
    assert silhouette_iou(_square(0.4), shifted)[0] == pytest.approx(50 / 150)
    assert silhouette_iou(_square(0.06), _square(1.0)) == 1
    assert silhouette_iou(_square(0.04), _square(1.0)) == 0
    assert silhouette_iou(EMPTY, _square(0.5)) == 0


def test_foreground_rmse_is_over_shared_pixels_in_mm() -> None:
    image = _square(0.6, columns=slice(10, 30))
    assert foreground_rmse_mm(image, _square(0.5), 300.0)[0] == pytest.approx(30, rel=1e-5)
    for apart in (EMPTY, _square(0.5, rows=slice(40, 50))):
        assert np.isnan(foreground_rmse_mm(apart, _square(0.5), 300.0))


def test_foreground_rmse_clips_at_farthest_surface() -> None:
    assert foreground_rmse_mm(_square(0.06), _square(MIN_V), 300.0)[0] == pytest.approx(0, abs=1e-6)
    assert foreground_rmse_mm(_square(0.06), _square(0.2), 300.0)[0] == pytest.approx(30, rel=1e-5)


def test_metrics_return_one_value_per_object() -> None:
    image = np.concatenate([_square(0.5), EMPTY, _square(0.2)])
    truth = np.concatenate([_square(0.5)] * 3)
    assert silhouette_iou(image, truth).tolist() == [1, 0, 1]
    for metric in (accuracy_mean_abs, accuracy_within_2_percent, lambda *both: foreground_rmse_mm(*both, 1.0)):
        assert metric(image, truth).shape == (3,)


def test_color_metrics_of_equal_images_are_perfect() -> None:
    truth = _colored((0.9, 0.2, 0.0))
    assert {name: value.item() for name, value in color_metrics(truth, truth).items()} == {
        "silhouette_iou": 1.0,
        "accuracy_mean_abs": 1.0,
        "root_mean_square_error": 0.0,
        "colour_error": 0.0,
    }


def test_wrong_color_is_no_error_of_silhouette() -> None:
    truth, image = _colored((0.9, 0.2, 0.1)), _colored((0.9, 0.5, 0.1))
    assert color_silhouette_iou(image, truth) == 1.0
    assert color_error(image, truth) == pytest.approx(0.3 / 3, rel=1e-5)
    assert color_accuracy_mean_abs(image, truth) == pytest.approx(1 - 0.25 * 0.9 * 0.3 / 3, rel=1e-5)
    assert root_mean_square_error(image, truth) == pytest.approx(np.sqrt(0.25 / 3) * 0.9 * 0.3, rel=1e-5)


def test_wrong_silhouette_is_no_error_of_color() -> None:
    truth, image = _colored((0.9, 0.2, 0.1)), _colored((0.9, 0.2, 0.1), slice(16, 32))
    assert color_silhouette_iou(image, truth) == 0.5
    assert color_error(image, truth) == 0.0
    assert np.isnan(color_error(np.zeros_like(truth), truth)).all()
    black, below = _colored((0.9, 0.2, 0.0)), _colored((0.9, 0.2, 0.0))
    below[:, 2, 16:48, 16:48] = 0.03  # below black is black
    assert color_error(below, black) == 0.0


def test_color_metrics_do_not_depend_on_channel_order() -> None:
    generator = np.random.default_rng(0)
    image, truth = generator.random((2, 4, 3, 64, 64), dtype=np.float32)
    turned = color_metrics(image[:, [2, 0, 1]], truth[:, [2, 0, 1]])
    for name, value in color_metrics(image, truth).items():
        np.testing.assert_allclose(value, turned[name], rtol=1e-12)
    np.testing.assert_array_equal(brightness(image), brightness(image[:, [2, 0, 1]]))
