"""The command for a GPU: its parts join to the same files, epochs fit the time; all of it in the small, on a CPU."""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

SMALL = """
task = "direct"
objects = 64
held_out = 20
epochs = 1
batch = 16
learning_rate = 1e-3
schedule = "cosine"
warm_up_steps = 2
average = 0.9
[direct]
features = 8
width = 8
blocks = 1
token = 8
mixers = 1
"""
ENCODER = """
task = "vae"
start = "decoder"
objects = 16
held_out = 4
epochs = 1
batch = 16
learning_rate = 1e-3
schedule = "one-cycle"
"""
COMPRESSOR = """
task = "compressor"
objects = 64
held_out = 20
epochs = 1
batch = 16
learning_rate = 1e-3
schedule = "one-cycle"
image_weight = 1.0
width = 0.1
"""


@pytest.fixture
def gpu(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("gpu_run")


def test_parts_are_small_and_join_to_the_same_files(
    gpu: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "PART_BYTES", 1000)
    folder = tmp_path / "weights"
    folder.mkdir()
    contents = {name: np.random.default_rng(k).bytes(1700) for k, name in enumerate(("a.safetensors", "b.json"))}
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    parts = gpu.write_parts(folder, list(contents), tmp_path / "direct.zip")
    assert len(parts) == 4
    assert max(part.stat().st_size for part in parts) <= 1000
    gpu.join_parts(parts[0], tmp_path / "joined")
    assert {path.name: path.read_bytes() for path in (tmp_path / "joined").iterdir()} == contents


def test_epochs_fit_the_time_by_the_fastest_epoch(gpu: ModuleType, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("epoch,loss,seconds\n0,1,30.0\n1,1,10.0\n", encoding="utf-8")
    assert gpu.epochs_within(100, log) == 9
    log.write_text("epoch,loss,seconds\n", encoding="utf-8")
    with pytest.raises(SystemExit, match="more --minutes"):
        gpu.epochs_within(100, log)


def test_recipe_gets_other_numbers(gpu: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("objects = 5\nepochs = 3\n", encoding="utf-8")
    made = gpu.recipe_with(tmp_path / "a.toml", tmp_path / "b.toml", epochs=70)
    assert made.read_text(encoding="utf-8") == "objects = 5\nepochs = 70\n"


@pytest.mark.slow
@pytest.mark.timeout(1200)  # processes start, render, train and evaluate one after the other
def test_whole_run_in_the_small(gpu: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "DIRECT_SHARE", 1e-9)  # two epochs
    monkeypatch.setattr(gpu, "TIMING_SHARE", 1.0)
    (tmp_path / "small.toml").write_text(SMALL, encoding="utf-8")
    (tmp_path / "encoder.toml").write_text(ENCODER, encoding="utf-8")
    (tmp_path / "compressor.toml").write_text(COMPRESSOR, encoding="utf-8")
    arguments = ["--out", str(tmp_path / "out"), "--minutes", "20", "--workers", "1", "--accelerator", "cpu"]
    small = ["--recipe", str(tmp_path / "small.toml"), "--held-out", "20", "--first-objects", "100"]
    paper = ["--encoder", str(tmp_path / "encoder.toml"), "--compressor", str(tmp_path / "compressor.toml")]
    chosen = gpu.options().parse_args([*arguments, *small, *paper, "--compressor-epochs", "1"])
    gpu.train_and_judge(chosen)
    facts = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert facts["objects"] >= 100
    for name in ("direct", "compressor"):
        assert 0 <= facts[name]["unseen"]["silhouette_iou"]["value"] <= 1
        assert facts[f"{name}_parts"][0] == f"{name}.00"
