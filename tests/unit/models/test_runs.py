"""Training runs: the weights and earlier runs that they start from, and outputs that are not
overwritten.
"""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from nlos_calibration.rig import load_rig
from nlos_models import CheckpointRecord, checkpoint
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError, TrainingError
from nlos_models.pipeline import RemappingNetwork
from nlos_models.records import UNCERTAINTY_RECORD
from nlos_models.training import open_fabric, runs
from nlos_models.training.checkpoints import (
    copy_weights,
    save_direct,
    save_pipeline,
    save_vae,
)
from nlos_models.training.recipe import Recipe
from nlos_models.training.run_files import FINISHED, LAST
from nlos_models.training.runs import (
    TrainingRun,
    compressor_start,
    record_run,
    record_uncertainty_run,
    run_vae,
    transfer_start,
    vae_start,
)
from safetensors.torch import load_file, save_file
from small_maps import SmallCompressor, SmallVae, small_images, use_small_networks
from small_run import changed_tensors, small_recipe
from small_uncertainty import watched_weights

from nlos_cam.files import CHECKSUMS, FileBusyError, OutputExistsError, claim

RIG = load_rig("paper-rig")
NAMED = (RIG.name, RIG.checksum)
VAE = small_recipe()
OTHER_VAE = small_recipe(seed=1)
TWO = small_recipe(task="compressor")
AGAIN = small_recipe(task="compressor", start="weights", seed=1)
JOINT = small_recipe(task="compressor", steps="two-then-joint", image_weight=1.0)
TRANSFER = small_recipe(task="transfer")
IMAGES_ALONE = {"latent_weight": 0, "image_weight": 1.0}


@pytest.fixture(autouse=True)
def _small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    use_small_networks(monkeypatch, checkpoint, runs)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Two-step weights with their encoder, so that they are a VAE too."""
    torch.manual_seed(1)
    vae = SmallVae()
    record = CheckpointRecord.of([VAE, TWO], NAMED)
    save_pipeline(
        tmp_path / "two", RemappingNetwork(SmallCompressor(), vae.decoder), record, vae.encoder
    )
    return tmp_path / "two"


def test_vae_start_lists_runs_of_the_vae_alone(
    weights: Path,
) -> None:
    stored = load_file(weights / "decoder.safetensors")["output.weight"].float()
    whole = vae_start(VAE, weights)
    (weights / "encoder.safetensors").unlink()
    one, other = (vae_start(small_recipe(start="decoder"), weights) for _ in range(2))
    for trained, earlier in (whole, one):
        assert earlier == [VAE]
        assert torch.equal(trained.decoder.output.weight, stored)

    assert not changed_tensors(one[0].state_dict(), other[0].state_dict())


def test_compressor_start_lists_runs_of_weights_and_vae(weights: Path, tmp_path: Path) -> None:
    start, runs = compressor_start(TWO, weights, None)

    assert (runs, start.pipeline) == ([VAE], None)

    save_vae(tmp_path / "other", SmallVae(), CheckpointRecord.of([OTHER_VAE], NAMED))
    start, runs = compressor_start(AGAIN, tmp_path / "other", weights)

    assert runs == [VAE, TWO, OTHER_VAE]
    assert not torch.equal(start.vae.decoder.output.weight, start.pipeline.decoder.output.weight)
    assert compressor_start(AGAIN, weights, weights)[1] == [TWO, VAE]

    start, runs = compressor_start(
        small_recipe(task="compressor", steps="one", **IMAGES_ALONE), None, None
    )

    assert (start.vae, start.pipeline, runs) == (None, None, [])


def test_folder_is_held_until_the_weights_are_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second run that began between the two would find neither state nor end, and train anew."""
    held: list[Path] = []

    def save(folder: Path, *_: object) -> None:
        with pytest.raises(FileBusyError), claim(folder, inside=True):
            pass
        held.append(folder)

    trained = SmallVae(), {"held_out_loss": 1.0}
    monkeypatch.setattr(runs, "train_vae", Mock(return_value=trained))
    monkeypatch.setattr(runs.checkpoints, "save_vae", save)
    training = TrainingRun(VAE, tmp_path, CheckpointRecord.of([VAE], NAMED))

    run_vae(
        open_fabric(VAE, accelerator="cpu"), training, None, small_images(2, 0), small_images(2, 1)
    )

    assert held == [tmp_path]
    with claim(tmp_path, inside=True):
        assert (tmp_path / FINISHED).exists()


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(b"cut")])
def test_finished_run_with_damaged_weights_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[Path], object]
) -> None:
    trained = SmallVae(), {"held_out_loss": 1.0}
    monkeypatch.setattr(runs, "train_vae", Mock(return_value=trained))
    training = TrainingRun(VAE, tmp_path, CheckpointRecord.of([VAE], NAMED))

    def train() -> object:
        fabric = open_fabric(VAE, accelerator="cpu")
        return run_vae(fabric, training, None, small_images(2, 0), small_images(2, 1))

    assert train() == train()

    damage(tmp_path / "decoder.safetensors")

    with pytest.raises(CheckpointError, match=r"decoder\.safetensors .*to train again"):
        train()


def _start(recipe: Recipe, weights: Path) -> object:
    if recipe.task == "transfer":
        return transfer_start(recipe, weights, partial=False, on_report=pytest.fail)
    return (
        vae_start(recipe, weights)
        if recipe.task == "vae"
        else compressor_start(recipe, weights, weights)
    )


@pytest.mark.parametrize(
    ("recipe", "changes", "words"),
    [
        *(
            (recipe, {"maps": "difference maps"}, "raw maps.* difference maps")
            for recipe in (AGAIN, JOINT, TRANSFER)
        ),
        *((recipe, {"width": 0.5}, r"1 .*0\.5") for recipe in (AGAIN, JOINT)),
        *((recipe, {"colour": True}, "simulation only") for recipe in (VAE, AGAIN, JOINT)),
    ],
)
def test_start_refuses_weights_of_other_kind(
    weights: Path, recipe: Recipe, changes: dict, words: str
) -> None:
    with pytest.raises(TrainingError, match=words):
        _start(recipe.model_copy(update=changes), weights)


def test_latent_loss_needs_weights_with_an_encoder(
    weights: Path,
) -> None:
    (weights / "encoder.safetensors").unlink()
    with pytest.raises(TrainingError, match="encoder"):
        _start(JOINT, weights)
    _start(JOINT.model_copy(update=IMAGES_ALONE), weights)


def test_start_refuses_color_weights_for_depth(weights: Path) -> None:
    record = CheckpointRecord.of([small_recipe(colour=True)], NAMED).model_dump_json()
    (weights / "checkpoint.json").write_text(record, encoding="utf-8")
    (weights / CHECKSUMS).unlink()
    for recipe in (AGAIN, JOINT, TRANSFER):
        with pytest.raises(TrainingError, match="simulation only"):
            _start(recipe, weights)


def test_transfer_default_weights_fit_its_loss(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = {"features": 8, "width": 8, "blocks": 1, "token": 8, "mixers": 1}
    straight = small_recipe(task="direct", direct=size)
    save_direct(
        tmp_path / "direct", DirectNetwork(straight.direct), CheckpointRecord.of([straight], NAMED)
    )
    shipped = {"paper": weights, "direct": tmp_path / "direct"}
    monkeypatch.setattr(runs, "weights_folder", lambda given, default: given or shipped[default])
    start = partial(transfer_start, partial=False, on_report=pytest.fail)

    assert start(TRANSFER, None)[1].runs == [VAE, TWO]
    assert start(TRANSFER.model_copy(update=IMAGES_ALONE), None)[1].runs == [straight]

    with pytest.raises(TrainingError, match="latent"):
        start(TRANSFER, shipped["direct"])


def test_partial_start_fills_missing_tensors_by_seed(weights: Path) -> None:
    tensors = load_file(weights / "compressor.safetensors")
    messages = list[str]()
    missing = tensors.pop("classifier.1.weight")
    save_file({**tensors, "more": missing}, weights / "compressor.safetensors")
    (weights / CHECKSUMS).unlink()
    rows: list[torch.Tensor] = []
    for seed in (3, 3, 4):
        torch.rand(1)
        recipe = small_recipe(task="transfer", seed=seed)
        pipeline, record = transfer_start(recipe, weights, partial=True, on_report=messages.append)
        rows.append(pipeline.compressor.get_parameter("classifier.1.weight").detach())
        assert record.runs == [VAE, TWO]
        assert all(word in messages[-1] for word in ("more", "classifier.1.weight"))

    assert torch.equal(rows[0], rows[1])
    assert not torch.equal(rows[0], rows[2])


def _record(out: Path, *recipes: Recipe, starts: tuple[Path | None, ...] = ()) -> CheckpointRecord:
    return record_run(recipes[-1], out, NAMED, list(recipes[:-1]), *starts)


@pytest.mark.parametrize("recipes", [(VAE,), (OTHER_VAE,), (OTHER_VAE, VAE)])
def test_record_run_refuses_weights_of_another_run(
    tmp_path: Path, recipes: tuple[Recipe, ...]
) -> None:
    record = _record(tmp_path, VAE, OTHER_VAE).model_copy(
        update={"figures": {"held_out_loss": 1.5}}
    )
    (tmp_path / "checkpoint.json").write_text(record.model_dump_json(), encoding="utf-8")
    _record(tmp_path, VAE, OTHER_VAE)  # the same run may be repeated

    with pytest.raises(OutputExistsError, match="--out"):
        _record(tmp_path, *recipes)


def test_record_of_before_may_lack_the_rig_and_the_light(tmp_path: Path) -> None:
    (out := tmp_path / "out").mkdir()
    earlier = record_run(VAE, out, NAMED, [])
    (out / "checkpoint.json").write_text(earlier.model_dump_json(exclude={"bare_wall_counts"}))

    record_run(VAE, out, NAMED, [], bench={"name": "mine"}, bare_wall_counts=60.0)


def test_record_of_a_run_refuses_a_file_and_its_own_start(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for name, starts in (("file", ()), ("run", (tmp_path / "x" / ".." / "run",))):
        with pytest.raises(OutputExistsError, match="--out"):
            _record(tmp_path / name, VAE, starts=starts)


@pytest.mark.parametrize(
    "name", ["checkpoint.json", "compressor.safetensors", "direct.safetensors"]
)
def test_uncertainty_run_keeps_other_weights_in_its_folder(tmp_path: Path, name: str) -> None:
    watched = watched_weights(tmp_path / "watched")
    recipe = small_recipe(task="doubt", outliers=2, empties=2)
    (out := tmp_path / "out").mkdir()
    # Copies of the watched weights: of a run that was stopped while it saved.
    for path in watched.iterdir():
        (out / path.name).write_bytes(path.read_bytes())
    record_uncertainty_run(recipe, out, watched, [])

    (out / name).write_bytes(b"another network")

    with pytest.raises(OutputExistsError, match="--out"):
        record_uncertainty_run(recipe, out, watched, [])


@pytest.mark.parametrize("stopped", [True, False])
def test_uncertainty_run_stopped_while_it_saved_goes_on(tmp_path: Path, stopped: bool) -> None:
    watched = watched_weights(tmp_path / "watched")
    recipe = small_recipe(task="doubt", outliers=2, empties=2)
    (out := tmp_path / "out").mkdir()
    (out / UNCERTAINTY_RECORD).touch()
    if stopped:  # its state goes once everything is saved
        (out / LAST).touch()

    with nullcontext() if stopped else pytest.raises(OutputExistsError, match="--out"):
        record_uncertainty_run(recipe, out, watched, [])


def test_copied_weights_bring_no_end_of_another_run(tmp_path: Path) -> None:
    start = watched_weights(tmp_path / "start")
    (start / FINISHED).write_text("{}")
    copy_weights(start, tmp_path / "out")

    assert (tmp_path / "out" / "checkpoint.json").exists()
    assert not (tmp_path / "out" / FINISHED).exists()
