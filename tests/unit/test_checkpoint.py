"""Checkpoints: float16 round trips, strict loading, and errors that say which file and what."""

import json
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from nlos_models import checkpoint
from nlos_models.checkpoint import (
    CheckpointRecord,
    load_encoder,
    load_fitting,
    load_pipeline,
    load_pipeline_partly,
    load_record,
    load_vae,
    save_pipeline,
    save_vae,
)
from nlos_models.compressor import Compressor
from nlos_models.errors import CheckpointError
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import Recipe
from nlos_models.vae import Decoder, Encoder, ResVae
from safetensors.torch import load_file, save_file
from torch import nn

RECIPE = Recipe(task="vae", objects=10, held_out=1, epochs=1, batch=2, learning_rate=1e-3)
RECORD = CheckpointRecord(
    rig_name="paper-rig", rig_checksum="0123456789ab", vae_recipe=RECIPE, figures={"held_out_iou": 0.5}
)
PARTS = ("compressor", "preprocess", "decoder")


def _worn(module: nn.Module) -> nn.Module:
    """A network whose statistics are not those of a new one; some are too small for float16."""
    generator = torch.Generator().manual_seed(1)
    for name, buffer in module.named_buffers():
        if buffer.is_floating_point():
            small = 1e-9 if "running_var" in name else 1.0
            buffer.copy_(small * torch.rand(buffer.shape, generator=generator))
    return module


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("pipeline")
    save_pipeline(folder, Pipeline(_worn(Compressor()), Decoder()), RECORD)
    return folder


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    """The same checkpoint, to be harmed: the files that a test replaces are its own."""
    for path in saved.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


def _replace(path: Path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


def _change(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    path.unlink()
    save_file(tensors, path)


def test_a_pipeline_comes_back_within_float16_and_its_statistics_exactly(tmp_path: Path) -> None:
    torch.manual_seed(0)
    pipeline = Pipeline(_worn(Compressor()), _worn(Decoder()))
    pipeline.preprocess.mean.copy_(torch.tensor([0.1, 1e-9, 20.0, 3.0]))
    pipeline.preprocess.spread.copy_(torch.tensor([1e-8, 0.2, 100_000.0, 3.0]))
    save_pipeline(tmp_path, pipeline, RECORD)
    loaded, record = load_pipeline(tmp_path)
    assert record == RECORD
    assert not loaded.training
    for name, tensor in pipeline.state_dict().items():
        back, exact = loaded.state_dict()[name], "running" in name or "preprocess" in name
        assert back.dtype == tensor.dtype
        torch.testing.assert_close(back, tensor, rtol=0 if exact else 1e-3, atol=0 if exact else 1e-7)


def test_a_narrower_compressor_is_loaded_as_narrow_as_it_was_trained(tmp_path: Path) -> None:
    narrow = RECIPE.model_copy(update={"task": "compressor", "width": 0.5})
    save_pipeline(tmp_path, Pipeline(Compressor(width=0.5), Decoder()), CheckpointRecord.of([narrow], ("a", "b")))
    loaded, _ = load_pipeline(tmp_path)
    assert 2 * sum(p.numel() for p in loaded.compressor.parameters()) < 2_552_096


def test_saving_a_loaded_checkpoint_gives_the_same_bits(saved: Path, tmp_path: Path) -> None:
    save_pipeline(tmp_path, *load_pipeline(saved))
    names = sorted(path.name for path in saved.iterdir())
    assert names == sorted(path.name for path in tmp_path.iterdir())
    for name in names:
        assert (tmp_path / name).read_bytes() == (saved / name).read_bytes()


def test_a_vae_comes_back_and_saves_to_the_same_bits(tmp_path: Path) -> None:
    torch.manual_seed(0)
    vae = ResVae()
    save_vae(tmp_path / "one", vae, RECORD)
    loaded, record = load_vae(tmp_path / "one")
    save_vae(tmp_path / "two", loaded, record)
    assert record == RECORD
    assert not loaded.training
    torch.testing.assert_close(loaded.state_dict(), vae.state_dict(), rtol=1e-3, atol=1e-7)
    for name in ("encoder", "decoder"):
        first, second = ((tmp_path / n / f"{name}.safetensors").read_bytes() for n in ("one", "two"))
        assert first == second


def test_weights_are_stored_in_half(saved: Path) -> None:
    tensors = load_file(saved / "decoder.safetensors")
    assert tensors["output.weight"].dtype == torch.float16
    assert all(t.dtype == torch.float32 for name, t in tensors.items() if "running" in name)


@pytest.mark.parametrize("part", PARTS)
def test_an_absent_file_is_named(folder: Path, part: str) -> None:
    (folder / f"{part}.safetensors").unlink()
    with pytest.raises(CheckpointError, match=rf"{part}\.safetensors cannot be read"):
        load_pipeline(folder)


@pytest.mark.parametrize("content", [b"", b"not tensors", b"\xff" * 64])
def test_a_corrupt_file_is_named(folder: Path, content: bytes) -> None:
    _replace(folder / "decoder.safetensors", content)
    with pytest.raises(CheckpointError, match=r"decoder\.safetensors cannot be read"):
        load_pipeline(folder)


def test_a_truncated_file_is_named(folder: Path) -> None:
    path = folder / "decoder.safetensors"
    _replace(path, path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=r"decoder\.safetensors cannot be read"):
        load_pipeline(folder)


@pytest.mark.parametrize("harm", ["missing", "extra", "misshapen"])
def test_a_tensor_that_does_not_fit_is_named(folder: Path, harm: str) -> None:
    path = folder / "decoder.safetensors"
    tensors = load_file(path)
    if harm == "missing":
        del tensors["output.bias"]
    if harm == "extra":
        tensors["output.more"] = torch.zeros(1)
    if harm == "misshapen":
        tensors["output.bias"] = torch.zeros(2)
    _change(path, tensors)
    with pytest.raises(CheckpointError, match=r"does not fit this network: .*output\.") as caught:
        load_pipeline(folder)
    assert "\n" not in str(caught.value)


def test_a_vae_is_no_pipeline(tmp_path: Path) -> None:
    save_vae(tmp_path, ResVae(), RECORD)
    with pytest.raises(CheckpointError, match="a VAE alone, with no compressor: name weights of"):
        load_pipeline(tmp_path)


def test_an_absent_folder_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="train one, or name another"):
        load_pipeline(tmp_path / "none")


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe\x00\x80"])
def test_a_corrupt_record_is_named(folder: Path, content: bytes) -> None:
    _replace(folder / "checkpoint.json", content)
    with pytest.raises(CheckpointError, match=r"checkpoint\.json"):
        load_record(folder)


@pytest.mark.parametrize(("field", "value"), [("rig_name", None), ("colour", "red"), ("input", "pictures")])
def test_a_wrong_field_of_the_record_is_named(folder: Path, field: str, value: str | None) -> None:
    facts = RECORD.model_dump(mode="json")
    if value is None:
        del facts[field]
    else:
        facts[field] = value
    _replace(folder / "checkpoint.json", json.dumps(facts).encode())
    with pytest.raises(CheckpointError, match=field):
        load_record(folder)


def test_the_encoder_goes_along_with_a_pipeline_if_there_is_one(saved: Path, tmp_path: Path) -> None:
    assert load_encoder(saved) is None
    encoder = _worn(Encoder())
    save_pipeline(tmp_path, load_pipeline(saved)[0], RECORD, encoder)
    loaded = load_encoder(tmp_path)
    assert loaded is not None
    assert not loaded.training
    torch.testing.assert_close(loaded.state_dict(), encoder.state_dict(), rtol=1e-3, atol=1e-7)


def test_the_shipped_weights_have_an_encoder_and_say_what_made_them() -> None:
    _, record = load_pipeline()
    assert load_encoder() is not None
    assert record.vae_recipe is not None
    assert (record.vae_recipe.augmentation, record.vae_recipe.keep) == ("mirror", "last")
    assert record.transfer_recipe is None


def test_what_fits_is_loaded_and_the_rest_reported(folder: Path) -> None:
    path = folder / "decoder.safetensors"
    tensors = load_file(path)
    del tensors["output.bias"]
    _change(path, {**tensors, "output.weight": torch.zeros(2), "output.more": torch.zeros(1)})
    decoder = Decoder()
    own = {name: tensor.clone() for name, tensor in decoder.state_dict().items()}
    report = load_fitting(path, decoder)
    assert report[1:] == (["output.bias"], ["output.more"], ["output.weight"])
    assert set(report.loaded) == own.keys() - {"output.bias", "output.weight"}
    assert str(report) == (
        f"{len(report.loaded)} tensors loaded; 1 missing (output.bias), 1 left over (output.more), "
        "1 misshapen (output.weight)"
    )
    for name, tensor in decoder.state_dict().items():
        wanted = tensors[name].float() if name in report.loaded else own[name].float()
        assert torch.equal(tensor.float(), wanted), name


def test_a_pipeline_is_loaded_in_part_only_where_its_compressor_is_the_one_that_does_not_fit(folder: Path) -> None:
    _, record, report = load_pipeline_partly(folder)
    assert record == RECORD
    assert str(report) == f"{len(report.loaded)} tensors loaded; all fit"
    _change(folder / "compressor.safetensors", {"nothing": torch.zeros(1)})
    with pytest.raises(CheckpointError, match="no tensor that fits"):
        load_pipeline_partly(folder)
    _change(folder / "decoder.safetensors", {"nothing": torch.zeros(1)})
    with pytest.raises(CheckpointError, match=r"decoder\.safetensors does not fit"):
        load_pipeline_partly(folder)


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "save_file", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(CheckpointError, match=r"cannot take the weights .*No space left.*: make room"):
        save_vae(tmp_path, ResVae(), RECORD)


@pytest.mark.parametrize("value", [1e6, float("nan"), float("inf")])
def test_weights_beyond_float16_are_refused_at_saving(tmp_path: Path, value: float) -> None:
    decoder = Decoder()
    nn.init.constant_(decoder.output.weight, value)
    with pytest.raises(CheckpointError, match=r"output\.weight does not fit into float16"):
        save_pipeline(tmp_path, Pipeline(Compressor(), decoder), RECORD)
