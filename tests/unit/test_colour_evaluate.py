"""Judging in colour: figures of perfect and trivial images, guesses without a network, and the picture."""

from pathlib import Path

import numpy as np
from matplotlib.image import imread
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import load_rig
from nlos_models.recipe import SIMULATION_ONLY

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import make_samples
from nlos_cam.evaluate.color import (
    better_than,
    colour_guesses,
    draw_colour_sheet,
    figures_of_colour,
    judge_colour,
    painted_maps,
)
from nlos_cam.objects.textures import TEXTURES


def _squares(colours: list[tuple[float, float, float]]) -> Float32:
    images = np.zeros((len(colours), 3, 64, 64), np.float32)
    for image, colour in zip(images, colours, strict=True):
        image[:, 20:40, 20:40] = np.array(colour)[:, None, None]
    return images


TRUTH = _squares([(1.0, 0.1, 0.1), (0.1, 1.0, 0.1)])


def test_the_truth_is_perfect_and_nothing_has_no_colour() -> None:
    perfect = judge_colour(TRUTH, TRUTH)
    assert perfect["silhouette_iou"] == perfect["accuracy_mean_abs"] == {"value": 1.0, "low": 1.0, "high": 1.0}
    assert perfect["colour_error"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    nothing = judge_colour(np.zeros_like(TRUTH), TRUTH)
    assert nothing["silhouette_iou"]["value"] == 0.0
    assert nothing["colour_error"] == {"value": None, "low": None, "high": None}


def test_guesses_are_what_their_names_say() -> None:
    guesses = colour_guesses(TRUTH, TRUTH)
    assert (guesses["all_background"] == 0).all()
    np.testing.assert_allclose(guesses["mean_object"][1], TRUTH.mean(0))
    shown = guesses["mean_colour"]
    np.testing.assert_array_equal(shown > 0, TRUTH > 0)
    np.testing.assert_allclose(shown[:, :, 30, 30], [[0.55, 0.55, 0.1]] * 2, rtol=1e-6)


def test_better_is_positive_for_every_metric() -> None:
    gains = better_than(np.zeros_like(TRUTH), TRUTH, TRUTH)
    assert gains.pop("colour_error") == {"value": None, "low": None, "high": None}
    assert {"silhouette_iou", "accuracy_mean_abs", "root_mean_square_error"} == set(gains)
    assert all(gain["value"] is not None and gain["value"] > 0 for gain in gains.values())
    mean = colour_guesses(TRUTH, TRUTH)["mean_object"]
    losses = better_than(TRUTH, mean, TRUTH)
    assert losses["silhouette_iou"]["value"] == 0
    assert all((losses[name]["value"] or 0) < 0 for name in ("root_mean_square_error", "colour_error"))


def test_the_figures_say_that_they_are_of_a_simulation_and_what_they_are_to_be_held_against() -> None:
    figures = figures_of_colour(TRUTH, TRUTH, {"other": np.zeros_like(TRUTH)}, TRUTH)
    assert (figures["note"], figures["objects"]) == (SIMULATION_ONLY, 2)
    assert figures["silhouette_iou"]["value"] == 1.0
    assert set(figures["baselines"]) == {"other", "all_background", "mean_object", "mean_colour"}
    assert set(figures["better_than"]) == {"mean_object", "mean_colour"}
    assert figures["better_than"]["mean_object"]["root_mean_square_error"]["low"] > 0


def test_painted_objects_look_as_those_of_a_dataset_do() -> None:
    plan = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft", textures=tuple(TEXTURES))
    samples, seen = make_samples(plan, [40]), list[tuple[int, int]]()
    maps = painted_maps(
        [*samples["object_depth_m"]], plan.rig, 40, "draft", lambda done, total: seen.append((done, total))
    )
    np.testing.assert_array_equal(maps.depth_m, samples["depth_m"])
    np.testing.assert_array_equal(maps.intensity, samples["intensity"])
    np.testing.assert_array_equal(maps.image.astype(np.float16), samples["image"])
    assert seen == [(1, 1)]


def test_the_picture_shows_the_colours_of_truth_and_reconstruction(tmp_path: Path) -> None:
    draw_colour_sheet(tmp_path / "sheet.png", TRUTH[::-1], TRUTH)
    pixels = imread(tmp_path / "sheet.png")[..., :3].reshape(-1, 3)
    red, green, yellow = ((np.abs(pixels - colour) < 0.05).all(1).sum() for colour in
        ((1.0, 0.1, 0.1), (0.1, 1.0, 0.1), (0.9, 0.9, 0.0)))  # fmt: skip
    assert red > 100  # once as truth, once as reconstruction
    assert abs(int(red) - int(green)) < 0.05 * red
    assert yellow > 100  # their difference, twice
