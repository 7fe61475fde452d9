"""Evaluations in color: figures, baselines and the sheet, beside samples of a dataset."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from color_figures import color_baselines, draw_color_sheet, figures_of_color, painted_maps
from matplotlib.image import imread
from nlos_calibration import load_rig
from nlos_models import SIMULATION_ONLY

from nlos_cam.dataset import DatasetPlan
from nlos_cam.dataset.samples import make_samples
from nlos_cam.objects.textures import TEXTURES

TRUTH = np.zeros((2, 3, 64, 64), np.float32)
TRUTH[:, :, 20:40, 20:40] = np.array([(1.0, 0.1, 0.1), (0.1, 1.0, 0.1)])[:, :, None, None]
NOTHING = np.zeros_like(TRUTH)


@pytest.fixture
def figures() -> dict[str, Any]:
    """Figures of the truth itself, beside an answer that shows nothing."""
    return figures_of_color(TRUTH, TRUTH, {"other": NOTHING}, TRUTH)


def test_truth_scores_one_without_error_of_color() -> None:
    found = figures_of_color(TRUTH, TRUTH, {}, TRUTH)

    exact = {"value": 1.0, "low": 1.0, "high": 1.0}

    assert found["silhouette_iou"] == exact
    assert found["accuracy_mean_abs"] == exact
    assert found["colour_error"] == {"value": 0.0, "low": 0.0, "high": 0.0}


def test_background_alone_scores_zero_and_has_no_color() -> None:
    found = figures_of_color(NOTHING, TRUTH, {}, TRUTH)

    assert found["silhouette_iou"]["value"] == 0.0
    assert found["colour_error"] == {"value": None, "low": None, "high": None}


def test_figures_say_that_they_are_simulated(figures: dict[str, Any]) -> None:
    assert figures["note"] == SIMULATION_ONLY
    assert figures["objects"] == 2


def test_figures_are_beside_other_answers_and_baselines(figures: dict[str, Any]) -> None:
    expected = {"other", "all_background", "mean_object", "mean_colour"}

    assert set(figures["baselines"]) == expected
    assert set(figures["better_than"]) == {"mean_object", "mean_colour"}


def test_truth_is_better_than_the_means(figures: dict[str, Any]) -> None:
    by = figures["better_than"]["mean_object"]
    painted = figures["better_than"]["mean_colour"]
    del painted["silhouette_iou"]  # the mean color has our silhouettes

    assert by["root_mean_square_error"]["low"] > 0
    assert all(gain["value"] > 0 for gain in painted.values())


def test_baselines_are_nothing_the_mean_and_the_mean_color() -> None:
    guesses = color_baselines(TRUTH, TRUTH)

    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][1], TRUTH.mean(0))

    expected = (TRUTH > 0) * np.array([0.55, 0.55, 0.1])[:, None, None]

    np.testing.assert_allclose(guesses["mean_colour"], expected, rtol=1e-6)


def test_painted_maps_match_dataset_samples() -> None:
    plan = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft", textures=tuple(TEXTURES))
    samples = make_samples(plan, [40])
    depths_m = [*samples["object_depth_m"]]
    seen = list[tuple[int, int]]()

    maps = painted_maps(depths_m, plan.rig, 40, "draft", lambda *at: seen.append(at))

    np.testing.assert_array_equal(maps.depth_m, samples["depth_m"])
    np.testing.assert_array_equal(maps.intensity, samples["intensity"])
    np.testing.assert_array_equal(maps.image.astype(np.float16), samples["image"])
    assert seen == [(1, 1)]


def test_color_sheet_shows_truth_reconstruction_and_difference(tmp_path: Path) -> None:
    draw_color_sheet(tmp_path / "sheet.png", TRUTH[::-1], TRUTH)

    pixels = imread(tmp_path / "sheet.png")[..., :3].reshape(-1, 3)
    colors = (1.0, 0.1, 0.1), (0.1, 1.0, 0.1), (0.9, 0.9, 0.0)
    red, green, yellow = ((np.abs(pixels - color) < 0.05).all(1).sum() for color in colors)

    assert red > 100  # once as truth, once as reconstruction
    assert abs(int(red) - int(green)) < 0.05 * red
    assert yellow > 100  # their difference, twice
