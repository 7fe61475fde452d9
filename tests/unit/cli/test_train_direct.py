"""`train direct`: a run belongs to its training maps and to its held-out maps."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_workers import samples_of
from nlos_calibration import load_rig
from nlos_models import shipped_folder
from nlos_models.training import runs
from nlos_models.training.run_files import FINISHED

from nlos_cam.dataset import HELD_OUT_SEED, DatasetPlan, open_packed_maps
from nlos_cam.dataset.packed import MAPS
from nlos_cam.dataset.shards import shard_path, store

RIG = load_rig("paper-rig")
OBJECTS = 4
RECIPE = """task = "direct"
objects = 4
held_out = 4
epochs = 1
batch = 4
learning_rate = 1e-3

[direct]
features = 8
width = 16
blocks = 1
token = 8
mixers = 0
"""


def dataset_in(folder: Path, first_seed: int) -> Path:
    """Write a dataset of maps at random."""
    noise = np.random.default_rng(first_seed)
    sizes = {"depth_m": (64, 80), "intensity": (64, 80), "image": (64, 64)}
    arrays = {name: noise.random((OBJECTS, *size), np.float32) for name, size in sizes.items()}
    arrays["image"] = arrays["image"].astype(np.float16)
    samples = {**samples_of(range(first_seed, first_seed + OBJECTS)), **arrays}
    folder.mkdir()
    store(shard_path(folder, first_seed), samples, DatasetPlan(RIG, first_seed).provenance, "")
    return folder


@pytest.mark.usefixtures("one_thread")
def test_a_run_does_not_go_on_with_other_held_out_maps(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its best epoch would be chosen by losses of two sets."""
    monkeypatch.setattr(runs, "export_folder", lambda _: None)
    (tmp_path / "direct.toml").write_text(RECIPE, encoding="utf-8")
    training, held_out, others = (
        dataset_in(tmp_path / name, seed)
        for name, seed in (("maps", 0), ("held", HELD_OUT_SEED), ("others", HELD_OUT_SEED + 100))
    )
    command = "train", "direct", "--recipe", tmp_path / "direct.toml", "--dataset", training
    out = "--out", tmp_path / "weights"

    first = run(*command, "--held-out", held_out, *out)

    assert run(*command, "--held-out", held_out, *out) == first
    assert "other weights or objects" in run(*command, "--held-out", others, *out, code=4).err


def test_a_folder_of_another_run_is_refused_before_packing(tmp_path: Path, run: Any) -> None:
    """Packing may take twenty minutes."""
    (tmp_path / "direct.toml").write_text(RECIPE, encoding="utf-8")
    out = Path(shutil.copytree(shipped_folder(), tmp_path / "out"))
    command = "train", "direct", "--recipe", tmp_path / "direct.toml", "--out", out
    sets = (
        *("--dataset", dataset_in(tmp_path / "maps", 0)),
        *("--held-out", dataset_in(tmp_path / "held", HELD_OUT_SEED)),
    )

    assert "weights from another run" in run(*command, *sets, code=1).err
    assert not (out / "packed" / MAPS).exists()


@pytest.mark.usefixtures("one_thread")
def test_a_run_of_an_earlier_version_goes_on(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its origin is that of the training maps alone."""
    monkeypatch.setattr(runs, "export_folder", lambda _: None)
    (tmp_path / "direct.toml").write_text(RECIPE, encoding="utf-8")
    command = "train", "direct", "--recipe", tmp_path / "direct.toml", "--out", tmp_path / "out"
    sets = (
        *("--dataset", dataset_in(tmp_path / "maps", 0)),
        *("--held-out", dataset_in(tmp_path / "held", HELD_OUT_SEED)),
    )
    first = run(*command, *sets)
    finished = tmp_path / "out" / FINISHED
    facts = json.loads(finished.read_text(encoding="utf-8"))
    with open_packed_maps([tmp_path / "maps"], tmp_path / "out" / "packed") as source:
        facts["origin"] = source.digest
    finished.write_text(json.dumps(facts), encoding="utf-8")

    assert run(*command, *sets) == first
