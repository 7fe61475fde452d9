"""Evaluation in color: figures of perfect and trivial images, baselines without a network, and the picture."""

from pathlib import Path

import numpy as np
from matplotlib.image import imread
from nlos_calibration.rig import load_rig
from nlos_models.recipe import SIMULATION_ONLY

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import make_samples
from nlos_cam.evaluate.color import color_baselines, draw_color_sheet, figures_of_color, painted_maps
from nlos_cam.objects.textures import TEXTURES

TRUTH = np.zeros((2, 3, 64, 64), np.float32)
TRUTH[:, :, 20:40, 20:40] = np.array([(1.0, 0.1, 0.1), (0.1, 1.0, 0.1)])[:, :, None, None]
NOTHING = np.zeros_like(TRUTH)
NO_VALUE = {"value": None, "low": None, "high": None}


def test_color_figures_score_truth_and_background() -> None:
    perfect, nothing = (figures_of_color(image, TRUTH, {}, TRUTH) for image in (TRUTH, NOTHING))
    assert perfect["silhouette_iou"] == perfect["accuracy_mean_abs"] == {"value": 1.0, "low": 1.0, "high": 1.0}
    assert perfect["colour_error"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert (nothing["silhouette_iou"]["value"], nothing["colour_error"]) == (0.0, NO_VALUE)


def test_color_guesses_are_background_mean_object_and_mean_color() -> None:
    guesses = color_baselines(TRUTH, TRUTH)
    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][1], TRUTH.mean(0))
    expected = (TRUTH > 0) * np.array([0.55, 0.55, 0.1])[:, None, None]
    np.testing.assert_allclose(guesses["mean_colour"], expected, rtol=1e-6)


def test_color_figures_name_baselines_and_simulation() -> None:
    figures = figures_of_color(TRUTH, TRUTH, {"other": NOTHING}, TRUTH)
    assert (figures["note"], figures["objects"], figures["silhouette_iou"]["value"]) == (SIMULATION_ONLY, 2, 1.0)
    assert set(figures["baselines"]) == {"other", "all_background", "mean_object", "mean_colour"}
    assert set(figures["better_than"]) == {"mean_object", "mean_colour"}
    assert figures["better_than"]["mean_object"]["root_mean_square_error"]["low"] > 0
    assert all(
        gain["value"] > 0 for name, gain in figures["better_than"]["mean_colour"].items() if name != "silhouette_iou"
    )


def test_painted_maps_match_dataset_samples() -> None:
    plan = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft", textures=tuple(TEXTURES))
    samples, seen = make_samples(plan, [40]), list[tuple[int, int]]()
    maps = painted_maps([*samples["object_depth_m"]], plan.rig, 40, "draft", lambda *at: seen.append(at))
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
