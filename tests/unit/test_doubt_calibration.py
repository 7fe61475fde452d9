"""Calibration recovers what a network's words were distorted by."""

import numpy as np
import pytest
from nlos_models.doubt_training import error_scale, shared_errors, temperature


def laplace(expected: np.ndarray, seed: int = 0) -> np.ndarray:
    return np.abs(np.random.default_rng(seed).laplace(0.0, expected))


@pytest.mark.parametrize("factor", [0.25, 1.0, 8.0])
def test_whatever_the_expected_errors_are_multiplied_by_is_taken_off_again(factor: float) -> None:
    expected = np.random.default_rng(1).uniform(0.01, 0.2, 20_000)
    error = laplace(expected)
    assert factor * error_scale(factor * expected, error) == pytest.approx(error_scale(expected, error))
    assert error_scale(expected, error) == pytest.approx(1.0, rel=0.03)


def test_the_unit_of_errors_does_not_matter() -> None:
    expected = np.random.default_rng(2).uniform(0.01, 0.2, 1000)
    error = laplace(expected)
    assert error_scale(1000 * expected, 1000 * error) == pytest.approx(error_scale(expected, error))


@pytest.mark.parametrize("true", [1.0, 2.0, 3.0])
def test_a_networks_overconfidence_is_found(true: float) -> None:
    generator = np.random.default_rng(3)
    logits = generator.normal(0.0, 2.0, 50_000)
    truth = generator.random(50_000) < 1 / (1 + np.exp(-logits))
    assert temperature(true * logits, truth) == pytest.approx(true, rel=0.1)


def test_where_all_are_told_apart_probabilities_stay_as_the_network_says() -> None:
    truth = np.arange(100) % 2 == 0
    assert temperature(np.where(truth, 9.0, -9.0), truth) == 1.0


def test_errors_are_of_pixels_that_both_have() -> None:
    made, truth = np.zeros((1, 2, 2)), np.zeros((1, 2, 2))
    made[0], truth[0] = [[0.5, 0.5], [0.0, 0.0]], [[0.25, 0.0], [0.5, 0.0]]
    shared, error = shared_errors(made, truth)
    assert shared.tolist() == [[[True, False], [False, False]]]
    assert error.tolist() == [0.25]
