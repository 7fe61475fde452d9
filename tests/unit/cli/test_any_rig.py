"""Weights for any rig: objects on rigs of their own, one network on the wall grid, figures on a rig
that it never saw.
"""

from pathlib import Path
from typing import Any

import pytest
from nlos_models import load_record

from nlos_cam.reconstruct import WALL_GRID

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
DOUBT = """task = "doubt"
objects = 30
held_out = 10
epochs = 1
batch = 10
learning_rate = 1e-3
outliers = 7
empties = 14
"""
BUILD = ("dataset", "build", "--any-rig", "--accuracy", "draft", "--workers", "1")
Run = Any


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("any-rig")
    (folder / "direct.toml").write_text(RECIPE, encoding="utf-8")
    (folder / "doubt.toml").write_text(DOUBT, encoding="utf-8")
    (folder / "far.toml").write_text(
        'base = "paper-rig"\nname = "far"\n[lidar]\ndistance_m = 0.25\nyaw_deg = 30.0\n',
        encoding="utf-8",
    )
    return folder


@pytest.mark.slow
def test_any_rig_from_objects_to_figures_on_another_rig(folder: Path, run: Run) -> None:
    run(*BUILD, "--out", folder / "objects", "--count", "100", "--expected-maps")
    run(*BUILD, "--out", folder / "held", "--count", "50", "--seed", "10000000")
    sets = ("--dataset", folder / "objects", "--held-out", folder / "held")
    run("train", "direct", "--recipe", folder / "direct.toml", *sets, "--out", folder / "weights")
    record = load_record(folder / "weights")

    assert record.rig_checksum == WALL_GRID.checksum
    assert record.rig_name == "wall grid"

    figures = run(
        *("evaluate", "--weights", folder / "weights", "--rig", folder / "far.toml"),
        *("--no-nearest", "--out", folder / "report"),
    )
    assert 0 <= figures["test"]["silhouette_iou"]["value"] <= 1
