"""Metrics of colour images: perfect is perfect, each kind of error counts where it should and nowhere else."""

import numpy as np
import pytest
from nlos_calibration.arrays import Float32
from nlos_models.metrics import (
    brightness,
    colour_accuracy_mean_abs,
    colour_error,
    colour_metrics,
    colour_silhouette_iou,
    root_mean_square_error,
)


def _square(colour: tuple[float, float, float], rows: slice = slice(16, 48)) -> Float32:
    image = np.zeros((1, 3, 64, 64), np.float32)
    image[:, :, rows, 16:48] = 0.1 + 0.9 * np.array(colour, np.float32)[:, None, None]
    return image


def test_the_truth_itself_is_perfect() -> None:
    truth = _square((0.9, 0.2, 0.0))
    values = colour_metrics(truth, truth)
    assert {name: value.item() for name, value in values.items()} == {
        "silhouette_iou": 1.0,
        "accuracy_mean_abs": 1.0,
        "root_mean_square_error": 0.0,
        "colour_error": 0.0,
    }


def test_a_wrong_colour_is_an_error_of_colour_and_not_of_silhouette() -> None:
    truth, image = _square((0.9, 0.2, 0.1)), _square((0.9, 0.5, 0.1))
    assert colour_silhouette_iou(image, truth) == 1.0
    assert colour_error(image, truth) == pytest.approx(0.3 / 3, rel=1e-5)
    assert colour_accuracy_mean_abs(image, truth) == pytest.approx(1 - 0.25 * 0.9 * 0.3 / 3, rel=1e-5)
    assert root_mean_square_error(image, truth) == pytest.approx(np.sqrt(0.25 / 3) * 0.9 * 0.3, rel=1e-5)


def test_a_wrong_silhouette_is_no_error_of_colour() -> None:
    truth, image = _square((0.9, 0.2, 0.1)), _square((0.9, 0.2, 0.1), slice(16, 32))
    assert colour_silhouette_iou(image, truth) == 0.5
    assert colour_error(image, truth) == 0.0


def test_a_channel_below_black_is_black() -> None:
    truth, image = _square((0.9, 0.2, 0.0)), _square((0.9, 0.2, 0.0))
    image[:, 2, 16:48, 16:48] = 0.03
    assert colour_error(image, truth) == 0.0


def test_objects_that_share_no_pixel_have_no_error_of_colour() -> None:
    nothing = np.zeros((1, 3, 64, 64), np.float32)
    assert np.isnan(colour_error(nothing, _square((1, 1, 1)))).all()


def test_metrics_do_not_know_the_channels_by_name() -> None:
    generator = np.random.default_rng(0)
    image, truth = generator.random((2, 4, 3, 64, 64), dtype=np.float32)
    turned = colour_metrics(image[:, [2, 0, 1]], truth[:, [2, 0, 1]])
    for name, value in colour_metrics(image, truth).items():
        np.testing.assert_allclose(value, turned[name], rtol=1e-12)
    np.testing.assert_array_equal(brightness(image), brightness(image[:, [2, 0, 1]]))
