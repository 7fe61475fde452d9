"""The kills of dataset builds compare bit for bit, and count what a kill leaves."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fake_farm import samples_of
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import DatasetPlan
from nlos_cam.dataset.shards import shard_path, store

PLAN = DatasetPlan(load_rig("paper-rig"), 0)
BUILDS = "import sys, time; open(sys.argv[1] + '/shard-000000000.part', 'wb').write(b'x'); time.sleep(60)"


@pytest.fixture
def kills(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("kill_builds")


def _dataset(folder: Path, harm: str = "") -> Path:
    folder.mkdir()
    samples = samples_of(range(3))
    if harm == "category":
        samples = {**samples, harm: samples[harm][::-1]}
    elif harm:
        values = samples[harm].copy()
        values.reshape(-1).view(np.uint8)[-1] ^= 1
        samples = {**samples, harm: values}
    store(shard_path(folder, 0), samples, PLAN.provenance, "")
    return folder


@pytest.mark.parametrize("harm", ["", "depth_m", "intensity", "image", "object_depth_m", "scene", "category"])
def test_one_bit_makes_a_difference(kills: ModuleType, tmp_path: Path, harm: str) -> None:
    found = kills.differing(_dataset(tmp_path / "one"), _dataset(tmp_path / "other", harm))
    assert found == ([harm] if harm else [])


@pytest.mark.slow
def test_a_kill_sees_what_was_left_half_written(kills: ModuleType, tmp_path: Path) -> None:
    folder = _dataset(tmp_path / "one")
    found = kills.kill([sys.executable, "-c", BUILDS, str(folder)], folder, 0, 1.0)
    assert (found.shards_before, found.shards_after, found.lost, found.left_running) == (1, 1, 0, 0)
    assert found.parts == 1
    assert found.killed


def test_a_lost_or_changed_shard_is_seen(kills: ModuleType, tmp_path: Path) -> None:
    folder = _dataset(tmp_path / "one")
    cut = "import sys; open(sys.argv[1], 'wb').write(b'x')"
    found = kills.kill([sys.executable, "-c", cut, str(shard_path(folder, 0))], folder, 0, 60.0)
    assert found.lost == 1
    assert not found.killed  # it was through before
