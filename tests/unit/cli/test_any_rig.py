"""Weights for any rig: objects on rigs of their own, one network on the wall grid, an answer on a
rig that it never saw.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import load_reconstructor, load_record

from nlos_cam.reconstruct import WALL_GRID, alignment
from nlos_cam.render import QUIET, Scene, Sensor, render

RECIPE = """task = "direct"
objects = 40
held_out = 10
epochs = 2
batch = 10
learning_rate = 1e-3
warm_up_steps = 1
range_offset_m = 0.002
wall_texture = 0.05

[direct]
features = 8
width = 16
blocks = 1
token = 8
mixers = 0
"""
BUILD = ("dataset", "build", "--any-rig", "--accuracy", "draft", "--workers", "1")
Run = Any


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("any-rig")
    (folder / "direct.toml").write_text(RECIPE, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_weights_for_any_rig_answer_on_another_one(folder: Path, run: Run) -> None:
    run(*BUILD, "--out", folder / "objects", "--count", "100", "--expected-maps")
    run(*BUILD, "--out", folder / "held", "--count", "50", "--seed", "10000000")
    sets = ("--dataset", folder / "objects", "--held-out", folder / "held")
    run("train", "direct", "--recipe", folder / "direct.toml", *sets, "--out", folder / "weights")
    record = load_record(folder / "weights")

    assert record.rig_checksum == WALL_GRID.checksum
    assert record.rig_name == "wall grid"

    judged = run(
        "evaluate", "--dataset", folder / "held", "--no-nearest", "--out", folder / "figures"
    )
    assert judged["silhouette_iou"]["value"] > 0.4  # by the shipped weights for any rig

    far = load_rig("paper-rig")
    far = far.model_copy(
        update={"lidar": far.lidar.model_copy(update={"distance_m": 0.25, "yaw_deg": 30.0})}
    )
    seen = Sensor(far, QUIET).maps(render(Scene(far), "draft").multi, None)
    aligned = alignment(far, record)
    assert aligned
    maps = aligned.align(seen)
    network = load_reconstructor(folder / "weights", folder / "graphs")
    image = network(maps.depth_m[None], maps.intensity[None])
    assert image.shape == (1, 64, 64)
    assert np.isfinite(image).all()
