"""Doubt networks on disk, tied to the weights that they judge, and at run time in ONNX Runtime."""

from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_models import DoubtRecord, doubt_network, load_uncertainty_model, records
from nlos_models.errors import CheckpointError
from small_doubt import untrained_doubt, watched_weights

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    return watched_weights(tmp_path / "watched")


@pytest.fixture
def record(tmp_path: Path, watched: Path) -> DoubtRecord:
    return untrained_doubt(tmp_path / "run", watched)


def test_saved_doubt_restores_with_watched_weights(tmp_path: Path, watched: Path, record: DoubtRecord) -> None:
    network, found = doubt_network.load_doubt(tmp_path / "run")
    assert found == record
    assert not network.training
    assert network.temperature.tolist() == [0.5, 2.0]
    assert float(network.error_scale) == 1.5
    assert (tmp_path / "run" / "doubt.safetensors").stat().st_size < 700_000
    for name in (*records.WATCHED, "checkpoint.json"):
        assert (tmp_path / "run" / name).read_bytes() == (watched / name).read_bytes()


def test_weights_without_doubt_network_load_none(tmp_path: Path, watched: Path) -> None:
    assert doubt_network.load_doubt(watched) is None
    assert load_uncertainty_model(watched, tmp_path) is None
    with pytest.raises(CheckpointError, match="compressor"):
        records.checksum_of_watched(tmp_path)


@pytest.mark.usefixtures("record")
@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((name, b"another") for name in records.WATCHED),
        *((records.DOUBT_RECORD, text) for text in (b"{", b'{"watches": "x"}', b"\xff")),
    ],
)
def test_load_doubt_refuses_other_weights_or_damaged_record(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / "run" / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=records.DOUBT_RECORD):
        doubt_network.load_doubt(tmp_path / "run")


def test_save_doubt_refuses_weights_changed_since_training(tmp_path: Path, watched: Path, record: DoubtRecord) -> None:
    network = doubt_network.load_doubt(tmp_path / "run")[0].network
    (watched / records.WATCHED[0]).write_bytes(b"another network")
    with pytest.raises(CheckpointError, match="watched"):
        doubt_network.save_doubt(tmp_path / "other", network, record, watched)


def test_saved_bare_wall_keeps_its_precision(tmp_path: Path, watched: Path, record: DoubtRecord) -> None:
    network, wall_m = doubt_network.load_doubt(tmp_path / "run")[0].network, 0.3 + 1e-4 * torch.rand(5, 64, 80)
    network.learn_bare(wall_m, wall_m)
    doubt_network.save_doubt(tmp_path / "second", network, record, watched)
    again = doubt_network.load_doubt(tmp_path / "second")[0].network
    torch.testing.assert_close(again.bare_depth_m, wall_m.median(0).values, rtol=0, atol=0)


@pytest.mark.slow
def test_doubter_onnx_equals_torch_and_is_exported_once(tmp_path: Path, record: DoubtRecord) -> None:
    folder, cache = tmp_path / "run", tmp_path / "cache"
    doubter = load_uncertainty_model(folder, cache)
    (model,) = cache.glob("doubt-*.onnx")
    written_ns = model.stat().st_mtime_ns
    again = load_uncertainty_model(folder, cache)
    assert again.record == doubter.record == record
    assert model.stat().st_mtime_ns == written_ns
    for count in (1, 5):
        generator = np.random.default_rng(count)
        depth_m = generator.uniform(0.2, 0.8, (count, 64, 80)).astype(np.float32)
        depth_m[generator.random(depth_m.shape) < 0.1] = np.nan
        intensity = generator.uniform(0, 255, depth_m.shape).astype(np.float32)
        image = generator.uniform(0, 1, (count, 64, 64)).astype(np.float32)
        with torch.inference_mode():
            theirs = doubt_network.load_doubt(folder)[0](*(torch.from_numpy(a) for a in (depth_m, intensity, image)))
        for mine, its in zip(again(depth_m, intensity, image), theirs, strict=True):
            assert mine.shape == tuple(its.shape)
            np.testing.assert_allclose(mine, its, rtol=1e-3, atol=1e-5)
