"""Checkpoints: float16 round trips, strict loading, errors that name the file, and the record of
training runs.
"""

import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from nlos_models import SIMULATION_ONLY, CheckpointRecord, checkpoint
from nlos_models.compressor import Compressor
from nlos_models.errors import CheckpointError
from nlos_models.pipeline import RemappingNetwork, new_vae
from nlos_models.training import checkpoints
from nlos_models.vae import Decoder, ResVae
from safetensors.torch import load_file, save
from small_run import RIG, small_recipe, state_of
from torch import nn

from nlos_cam.files import CHECKSUMS

pytestmark = pytest.mark.usefixtures("narrow_networks", "one_thread")

RUNS = {f"v{seed}": small_recipe(seed=seed) for seed in range(3)}
RUNS |= {f"c{seed}": small_recipe(task="compressor", seed=seed) for seed in range(2)}
RUNS |= {f"t{seed}": small_recipe(task="transfer", seed=seed) for seed in range(2)}
RUNS |= {f"d{seed}": small_recipe(task="direct", seed=seed) for seed in range(2)}
RUNS["j"] = small_recipe(task="compressor", seed=9, steps="two-then-joint", image_weight=1.0)
RECORD = CheckpointRecord.of([RUNS["v0"]], RIG).model_copy(
    update={"figures": {"held_out_iou": 0.5}}
)
PARTS = ("compressor", "preprocess", "decoder")


def _used(module: nn.Module) -> nn.Module:
    """Return a network whose statistics are not a new one's; some are too small for float16."""
    generator = torch.Generator().manual_seed(1)
    for name, buffer in module.named_buffers():
        if buffer.is_floating_point():
            small = 1e-9 if "running_var" in name else 1.0
            buffer.copy_(small * torch.rand(buffer.shape, generator=generator))
    return module


@pytest.fixture(scope="module")
def saved(narrow_networks: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    del narrow_networks
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("pipeline")
    checkpoints.save_pipeline(folder, RemappingNetwork(_used(Compressor()), Decoder()), RECORD)
    return folder


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    """The same checkpoint as links and without checksums, so that a test may replace files."""
    for path in saved.iterdir():
        if path.name != CHECKSUMS:
            (tmp_path / path.name).symlink_to(path)
    return tmp_path


def _replace(path: Path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


@pytest.mark.parametrize("width", [1.0, 0.5])
def test_pipeline_round_trip_is_float16_with_exact_statistics(tmp_path: Path, width: float) -> None:
    torch.manual_seed(0)
    pipeline = RemappingNetwork(_used(Compressor(width=width)), _used(Decoder()))
    saved = CheckpointRecord.of([small_recipe(task="compressor", width=width)], RIG)
    pipeline.preprocess.mean.copy_(torch.tensor([0.1, 1e-9, 20.0, 3.0]))
    pipeline.preprocess.spread.copy_(torch.tensor([1e-8, 0.2, 100_000.0, 3.0]))
    checkpoints.save_pipeline(tmp_path, pipeline, saved)
    loaded, record = checkpoint.load_pipeline(tmp_path)

    assert record == saved
    assert not loaded.training

    for name, tensor in pipeline.state_dict().items():
        back = loaded.state_dict()[name]
        exact = "running" in name or "preprocess" in name
        assert back.dtype == tensor.dtype
        torch.testing.assert_close(
            back, tensor, rtol=0 if exact else 1e-3, atol=0 if exact else 1e-7
        )
    tensors = load_file(tmp_path / "decoder.safetensors")

    assert tensors["output.weight"].dtype == torch.float16
    assert all(t.dtype == torch.float32 for name, t in tensors.items() if "running" in name)


@pytest.mark.parametrize("color", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vae_round_trip_keeps_weights_and_bytes(tmp_path: Path, color: bool) -> None:
    torch.manual_seed(0)
    vae = new_vae(color=color)
    saved = CheckpointRecord.of([small_recipe(colour=color)], RIG)
    checkpoints.save_vae(tmp_path / "one", vae, saved)
    loaded, record = checkpoints.load_vae(tmp_path / "one")
    checkpoints.save_vae(tmp_path / "two", loaded, record)

    assert record == saved
    assert not loaded.training
    torch.testing.assert_close(loaded.state_dict(), vae.state_dict(), rtol=1e-3, atol=1e-7)

    for name in ("encoder", "decoder"):
        first, second = (
            (tmp_path / n / f"{name}.safetensors").read_bytes() for n in ("one", "two")
        )
        assert first == second
    checkpoints.save_vae(tmp_path / "two", new_vae(color=not color), saved)

    with pytest.raises(CheckpointError, match="encoder"):
        checkpoints.load_vae(tmp_path / "two")


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("content", [None, b"", b"not tensors", b"\xff" * 64, "truncated"], ids=str)
def test_load_pipeline_names_missing_or_corrupt_file(
    folder: Path, part: str, content: bytes | str | None
) -> None:
    path = folder / f"{part}.safetensors"
    whole = path.read_bytes()
    path.unlink()
    if content is not None:
        path.write_bytes(whole[:-100] if isinstance(content, str) else content)

    with pytest.raises(CheckpointError, match=rf"{part}\.safetensors"):
        checkpoint.load_pipeline(folder)


@pytest.mark.parametrize("seed", range(25))
def test_load_pipeline_refuses_any_flipped_bit(folder: Path, saved: Path, seed: int) -> None:
    (folder / CHECKSUMS).symlink_to(saved / CHECKSUMS)
    random = np.random.default_rng(seed)
    path = folder / f"{random.choice(PARTS)}.safetensors"
    content = bytearray(path.read_bytes())
    content[random.integers(len(content))] ^= 1 << random.integers(8)
    _replace(path, bytes(content))

    with pytest.raises(CheckpointError, match=rf"{path.stem}\.safetensors"):
        checkpoint.load_pipeline(folder)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("output.bias", None, r"output\."),
        ("output.bias", torch.zeros(2), r"output\."),
        ("output.more", torch.zeros(2), r"output\."),
        *(("output.bias", torch.tensor([value]), "not finite") for value in (torch.nan, torch.inf)),
    ],
)
def test_load_pipeline_refuses_unusable_tensors(
    folder: Path, name: str, value: torch.Tensor | None, word: str
) -> None:
    tensors = {**load_file(path := folder / "decoder.safetensors"), name: value}
    _replace(path, save({name: tensor for name, tensor in tensors.items() if tensor is not None}))
    with pytest.raises(CheckpointError, match=word) as caught:
        checkpoint.load_pipeline(folder)

    assert "\n" not in str(caught.value)


RECORD_JSON = RECORD.model_dump(mode="json")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        *((content, r"checkpoint\.json") for content in (b"", b"{", b"[]", b"\xff\xfe\x00\x80")),
        (RECORD_JSON | {"colour": "red"}, "colour"),
        (RECORD_JSON | {"input": "pictures"}, "input"),
        ({name: value for name, value in RECORD_JSON.items() if name != "rig_name"}, "rig_name"),
    ],
)
def test_load_record_names_corrupt_file_or_wrong_field(
    tmp_path: Path, content: bytes | dict, word: str
) -> None:
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    (tmp_path / "checkpoint.json").write_bytes(text)
    with pytest.raises(CheckpointError, match=word):
        checkpoint.load_record(tmp_path)


def test_load_fitting_loads_matching_tensors_and_reports_rest(folder: Path) -> None:
    path = folder / "decoder.safetensors"
    tensors = load_file(path)
    del tensors["output.bias"]
    _replace(
        path, save({**tensors, "output.weight": torch.zeros(2), "output.more": torch.zeros(1)})
    )
    decoder = Decoder()
    own = state_of(decoder)
    report = checkpoints.load_fitting(path, decoder)

    assert report[1:] == (["output.bias"], ["output.more"], ["output.weight"])
    assert set(report.loaded) == own.keys() - {"output.bias", "output.weight"}
    assert all(
        name in str(report)
        for name in (f"{len(report.loaded)}", "output.bias", "output.more", "output.weight")
    )

    for name, tensor in decoder.state_dict().items():
        wanted = tensors[name] if name in report.loaded else own[name]
        assert torch.equal(tensor.float(), wanted.float()), name


def test_load_pipeline_partly_is_strict_but_for_compressor(folder: Path) -> None:
    _, record, report = checkpoints.load_pipeline_partly(folder)

    assert record == RECORD
    assert report[1:] == ([], [], [])

    for part in ("compressor", "decoder"):
        _replace(folder / f"{part}.safetensors", save({"nothing": torch.zeros(1)}))
        with pytest.raises(CheckpointError, match=rf"{part}\.safetensors"):
            checkpoints.load_pipeline_partly(folder)


def test_save_refuses_weights_beyond_float16_or_on_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for value in (1e6, torch.nan, torch.inf):
        nn.init.constant_((decoder := Decoder()).output.weight, value)
        with pytest.raises(CheckpointError, match=r"output\.weight"):
            checkpoints.save_pipeline(tmp_path, RemappingNetwork(Compressor(), decoder), RECORD)
    monkeypatch.setattr(
        checkpoint, "write_checked", Mock(side_effect=OSError(28, "No space left on device"))
    )

    with pytest.raises(CheckpointError, match="No space left"):
        checkpoints.save_vae(tmp_path, ResVae(), RECORD)


@pytest.mark.parametrize(
    ("runs", "named", "earlier"),
    [
        ("v0", ["v0", "", ""], ""),
        ("v0 v1 v2", ["v2", "", ""], "v0 v1"),
        ("v0 c0", ["v0", "c0", ""], ""),
        ("v0 c0 c1", ["v0", "c1", ""], "c0"),
        ("c0 v0 c1", ["v0", "c1", ""], "c0"),
        ("v0 c0 j", ["v0", "j", ""], "c0"),
        ("v0 c0 v1 c1", ["v1", "c1", ""], "v0 c0"),
        ("v0 c0 t0 t1", ["v0", "c0", "t1"], "t0"),
        ("v0 c0 t0 j", ["v0", "j", ""], "c0 t0"),
        ("d0 t0", ["", "", "t0"], ""),
        ("d0 t0 d1", ["", "", ""], "d0 t0"),
    ],
)
def test_record_names_last_run_of_each_task_and_keeps_others(
    runs: str, named: list[str], earlier: str
) -> None:
    record = CheckpointRecord.of([RUNS[name] for name in runs.split()], RIG, "difference maps")
    latest = [record.vae_recipe, record.compressor_recipe, record.transfer_recipe]

    assert latest == [RUNS.get(name) for name in named]
    assert record.earlier == [RUNS[name] for name in earlier.split()]
    assert sorted(name for name, run in RUNS.items() if run in record.runs) == sorted(runs.split())
    assert (record.rig_name, record.rig_checksum, record.input) == (*RIG, "difference maps")
    assert CheckpointRecord.model_validate_json(record.model_dump_json()) == record


def test_record_vae_runs_include_runs_that_train_decoder() -> None:
    record = CheckpointRecord.of([RUNS[name] for name in ("v0", "v1", "c0", "j", "t0")], RIG)

    assert record.vae_runs == [RUNS[name] for name in ("v0", "v1", "j")]

    written_before_earlier = RECORD.model_dump(mode="json", exclude={"earlier"})

    assert CheckpointRecord.model_validate(written_before_earlier).runs == [RUNS["v0"]]


def test_record_in_color_notes_simulation_only() -> None:
    runs = [small_recipe(colour=True), small_recipe(task="compressor", colour=True)]
    for some in (runs[:1], runs[1:], runs):
        record = CheckpointRecord.of(some, RIG)
        assert (record.color, record.note) == (True, SIMULATION_ONLY)
        assert CheckpointRecord.model_validate_json(record.model_dump_json()) == record
        assert CheckpointRecord.model_validate(record.model_dump(exclude={"note"})) == record
    depth = CheckpointRecord.of([RUNS["v0"], RUNS["c0"]], RIG)

    assert (depth.color, depth.note) == (False, "")
