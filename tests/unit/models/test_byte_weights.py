"""Weights in a byte each: rounding within its bound, networks and graphs that answer as before."""

import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nlos_models.byte_weights import GROUPS, LARGEST, fits_bytes, from_bytes, to_bytes
from nlos_models.checkpoint import load_pipeline, read_tensors
from nlos_models.compressor import Compressor
from nlos_models.errors import CheckpointError
from nlos_models.export import export_folder
from nlos_models.inference import load_reconstructor
from nlos_models.pipeline import RemappingNetwork
from nlos_models.quality import UNCERTAINTY_FILES, load_quality_model
from nlos_models.records import (
    checksum_of_watched,
    load_uncertainty_record,
    shipped_folder,
)
from nlos_models.training import byte_storage, store_in_bytes
from nlos_models.training.checkpoints import save_pipeline
from nlos_models.vae import Decoder
from safetensors.torch import load_file, save, save_file
from small_maps import noise_maps
from small_run import small_record

from nlos_cam.files import write_checked

pytestmark = pytest.mark.usefixtures("one_thread")

RECORD = small_record()
SMALLEST_SCALE = float(np.finfo(np.float16).smallest_subnormal)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    save_pipeline(folder, RemappingNetwork(Compressor(), Decoder()), RECORD)
    return folder


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "weights"))


@pytest.fixture
def halves(tmp_path: Path) -> Path:
    """Shipped weights as they were trained, in float16, with the judges that watch them."""
    folder = Path(shutil.copytree(shipped_folder("direct"), tmp_path / "halves"))
    watched = checksum_of_watched(folder), checksum_of_watched(folder, UNCERTAINTY_FILES)
    tensors = {
        name: tensor if name.startswith("normal.") else tensor.half()
        for name, tensor in read_tensors(folder / "direct.safetensors").items()
    }
    write_checked(folder, {"direct.safetensors": save(tensors)})

    def tie(name: str, before: str, now: str) -> None:
        text = (folder / name).read_text(encoding="utf-8").replace(before, now)
        write_checked(folder, {name: text.encode()})

    tie("doubt.json", watched[0], checksum_of_watched(folder))
    tie("quality.json", watched[1], checksum_of_watched(folder, UNCERTAINTY_FILES))
    return folder


@pytest.mark.parametrize("group", GROUPS)
@given(seed=st.integers(0, 1000), size=st.sampled_from([1e-30, 1e-5, 1e-3, 1.0, 1e4]))
def test_bytes_are_within_half_a_scale(group: int, seed: int, size: float) -> None:
    random = np.random.default_rng(seed)
    weight = (size * random.standard_normal((8, 3, group))).astype(np.float32)
    weight[0] = 0

    back = from_bytes(*to_bytes(weight))

    largest = np.abs(weight).reshape(-1, group).max(axis=1, keepdims=True)
    off = np.abs(back - weight).reshape(-1, group)
    assert back.shape == weight.shape
    # a scale in float16 is up to 1/1000 too large, and at least SMALLEST_SCALE
    assert (off <= 0.501 * largest / LARGEST + SMALLEST_SCALE / 2).all()
    np.testing.assert_array_equal(back[0], 0)


def test_storing_twice_changes_no_bit() -> None:
    weight = np.random.default_rng(0).standard_normal((64, GROUPS[0])).astype(np.float32)
    once = from_bytes(*to_bytes(weight))

    np.testing.assert_array_equal(from_bytes(*to_bytes(once)), once)


def test_scales_of_32_bits_keep_their_bytes() -> None:
    random = np.random.default_rng(0)
    weight = random.integers(-127, 128, (64, 64), np.int8)
    weight[:, 0] = LARGEST
    scale = random.uniform(1e-4, 1e-3, (64, 1)).astype(np.float32)  # as the shipped ones

    again, _ = to_bytes(from_bytes(weight, scale))

    np.testing.assert_array_equal(again, weight)


@pytest.mark.parametrize(
    ("shape", "fits"),
    [
        ((64, 64), True),
        ((256, 128, 3, 3), True),
        ((960, 160, 1, 1), True),
        ((4096,), False),
        ((8, 64), False),
    ],
)
def test_large_weights_in_whole_groups_fit(shape: tuple[int, ...], fits: bool) -> None:
    assert fits_bytes(shape) == fits
    assert not fits_bytes((100, 63))


def test_stored_pipeline_is_half_as_large_and_answers_alike(folder: Path) -> None:
    maps = [torch.from_numpy(part) for part in noise_maps(4)]
    before = load_pipeline(folder)[0]
    size = (folder / "decoder.safetensors").stat().st_size
    with torch.inference_mode():
        wanted = before.latent(*maps)

    store_in_bytes(folder)
    with torch.inference_mode():
        found = load_pipeline(folder)[0].latent(*maps)

    assert (folder / "decoder.safetensors").stat().st_size < 0.56 * size
    assert float((found - wanted).abs().mean()) < 0.02 * float(wanted.std())


def test_normalization_is_stored_in_full(halves: Path) -> None:
    """Training had it exactly, and mirrored maps need the same numbers on both sides."""
    before = load_file(halves / "direct.safetensors")

    store_in_bytes(halves)

    after = load_file(halves / "direct.safetensors")
    for name in ("normal.median", "normal.spread"):
        assert torch.equal(after[name], before[name])
        assert torch.equal(after[name], after[name].flip(-2))


@pytest.mark.slow
def test_graph_of_bytes_equals_full_export_bit_for_bit(folder: Path, tmp_path: Path) -> None:
    maps = noise_maps(3)
    store_in_bytes(folder)
    full = load_reconstructor(folder, tmp_path / "cache")
    (graph,) = export_folder(folder)

    linked = load_reconstructor(folder, tmp_path / "unused")

    assert graph.stat().st_size < 400_000
    np.testing.assert_array_equal(linked(*maps), full(*maps))
    assert not (tmp_path / "unused").exists()


def test_judges_of_stored_weights_are_tied_to_them(halves: Path) -> None:
    before = checksum_of_watched(halves)

    store_in_bytes(halves)

    record = load_uncertainty_record(halves)
    assert record is not None
    assert record.watches == checksum_of_watched(halves) != before
    assert load_quality_model(halves) is not None


def test_interrupted_storage_leaves_weights_whole(
    halves: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in halves.iterdir()}

    # The weights are in bytes by then, and the uncertainty network is not yet tied to them.
    with monkeypatch.context() as patch:
        patch.setattr(byte_storage, "save_parts", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            store_in_bytes(halves)

    assert {path.name: path.read_bytes() for path in halves.iterdir()} == before
    store_in_bytes(halves)
    assert load_uncertainty_record(halves) is not None


@pytest.mark.parametrize("harm", ["short", "alone"])
def test_scales_that_fit_no_bytes_are_refused(folder: Path, harm: str) -> None:
    store_in_bytes(folder)
    path = folder / "decoder.safetensors"
    tensors = load_file(path)
    name = next(each for each in tensors if each.endswith(".scale"))
    if harm == "short":
        tensors[name] = tensors[name][:-1].clone()
    else:
        del tensors[name.removesuffix(".scale")]
    path.unlink()
    (folder / "SHA256SUMS").unlink()
    save_file(tensors, path)

    with pytest.raises(CheckpointError, match=r"decoder\.safetensors.*scales"):
        read_tensors(path)
