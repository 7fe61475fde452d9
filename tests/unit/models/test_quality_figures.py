"""Figures that a quality is predicted from: their order, which quality.json stores, and values."""

import json

import numpy as np
import pytest
from nlos_models import BENCH_WEIGHTS, quality_features, shipped_folder
from nlos_models.quality import QUALITY
from nlos_models.quality_figures import FIGURES, SURFACE_FIGURES, UncertaintyEstimate

LEVELS = 0.1, 0.3, 0.5, 0.7, 0.9
ORDER = [
    *("overlap", "logit of overlap", "area", "log of area", "root of area"),
    *("p inside", "p beside", "unsure", "unsure inside"),
    *(f"{name} above {level}" for level in LEVELS for name in ("IoU", "area")),
    *("mean error", "RMS error", "mean v", "spread of v", "roughness", "thinness"),
    *("step of v down", "step of v across"),
    *("rows off the middle", "column", "height", "width", "height over width", "fill"),
    *("logit of unlike the training", "logit of empty"),
]
SURFACE_ORDER = [
    *("own overlap", "logit of own overlap"),
    *("own p inside", "own p beside", "own unsure", "own unsure inside"),
    *(f"{name} above own {level}" for level in LEVELS for name in ("IoU", "area")),
    *("difference of the networks", "difference of the networks inside", "own decided"),
]
SHARE = 0.8
OWN_SHARE = 0.4
KNOWN = {
    # 16 x 8 pixels of v = 0.5; p is SHARE on the 16 x 16 pixels whose left half they are.
    "area": 128 / 4096,
    "log of area": np.log(128),
    "root of area": np.sqrt(128),
    "p inside": SHARE,
    "p beside": SHARE,
    "overlap": SHARE / (1 + SHARE),
    "logit of overlap": np.log(SHARE),
    "unsure": 2 * SHARE * (1 - SHARE),
    "unsure inside": SHARE * (1 - SHARE),
    "IoU above 0.7": 0.5,
    "area above 0.7": 2.0,
    "IoU above 0.9": 0.0,
    "mean error": 0.25,
    "RMS error": 0.25,
    "mean v": 0.5,
    "spread of v": 0.0,
    "roughness": 48 / np.sqrt(128),
    "thinness": 48 / 128,
    "step of v down": 0.0,
    "rows off the middle": 16.0,
    "column": 23.5,
    "height": np.sqrt((16**2 - 1) / 12),
    "width": np.sqrt((8**2 - 1) / 12),
    "height over width": np.sqrt((16**2 - 1) / (8**2 - 1)),
    "logit of unlike the training": np.log(3),
    "logit of empty": -np.log(3),
    # The own network's p is OWN_SHARE on the image's surface alone.
    "own overlap": OWN_SHARE,
    "own p beside": 0.0,
    "own unsure": OWN_SHARE * (1 - OWN_SHARE),
    "IoU above own 0.3": 1.0,
    "area above own 0.5": 0.0,
    "difference of the networks": 2 * SHARE - OWN_SHARE,
    "difference of the networks inside": SHARE - OWN_SHARE,
    "own decided": OWN_SHARE,
}


def test_tables_have_the_order_of_stored_models() -> None:
    assert list(FIGURES) == ORDER
    assert list(SURFACE_FIGURES) == SURFACE_ORDER


@pytest.mark.parametrize("name", BENCH_WEIGHTS)
def test_shipped_models_have_a_number_for_each_figure(name: str) -> None:
    record = json.loads((shipped_folder(name) / QUALITY).read_text(encoding="utf-8"))

    assert len(record["means"]) == len(ORDER) + len(SURFACE_ORDER)


def test_figures_of_a_rectangle_have_their_known_values() -> None:
    image = np.zeros((1, 64, 64), np.float32)
    image[0, 8:24, 20:28] = 0.5
    p = np.zeros_like(image)
    p[0, 8:24, 20:36] = SHARE
    half = np.full(1, 0.75, np.float32)
    estimate = UncertaintyEstimate(1 - half, half, np.full_like(image, 0.25), p)

    (figures,) = quality_features(image, estimate, OWN_SHARE * (image > 0).astype(np.float32))

    found = dict(zip([*FIGURES, *SURFACE_FIGURES], figures.tolist(), strict=True))
    assert {name: found[name] for name in KNOWN} == pytest.approx(KNOWN, rel=1e-4, abs=1e-5)
