"""Doubt at run time: ONNX Runtime held equal to torch, exported once."""

from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_models.doubt_checkpoint import Doubter, load_doubt, load_doubter
from small_doubt import untrained_doubt, watched_weights


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("doubt")
    untrained_doubt(folder / "run", watched_weights(folder / "watched"))
    return folder / "run", folder / "cache"


@pytest.fixture(scope="module")
def doubter(folders: tuple[Path, Path]) -> Doubter:
    found = load_doubter(*folders)
    assert found is not None
    return found


@pytest.mark.parametrize("count", [1, 5])
def test_onnx_equals_torch(folders: tuple[Path, Path], doubter: Doubter, count: int) -> None:
    generator = np.random.default_rng(count)
    depth_m = generator.uniform(0.2, 0.8, (count, 64, 80)).astype(np.float32)
    depth_m[generator.random(depth_m.shape) < 0.1] = np.nan
    intensity = generator.uniform(0, 255, depth_m.shape).astype(np.float32)
    image = generator.uniform(0, 1, (count, 64, 64)).astype(np.float32)
    loaded = load_doubt(folders[0])
    assert loaded is not None
    with torch.inference_mode():
        theirs = loaded[0](*(torch.from_numpy(a) for a in (depth_m, intensity, image)))
    for mine, its in zip(doubter(depth_m, intensity, image), theirs, strict=True):
        assert mine.shape == tuple(its.shape)
        np.testing.assert_allclose(mine, its, rtol=1e-3, atol=1e-5)


def test_it_is_exported_once(folders: tuple[Path, Path], doubter: Doubter) -> None:
    (model,) = folders[1].glob("doubt-*.onnx")
    written_ns = model.stat().st_mtime_ns
    again = load_doubter(*folders)
    assert again is not None
    assert again.record == doubter.record
    assert model.stat().st_mtime_ns == written_ns


def test_weights_without_a_doubt_network_have_no_doubter(folders: tuple[Path, Path], tmp_path: Path) -> None:
    assert load_doubter(folders[0].parent / "watched", tmp_path) is None
